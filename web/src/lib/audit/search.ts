import { ApiError, type Api } from '../api/client';
import type { EventList, Invocation, LogEvent } from '../api/documents';
import { titleOf } from '../format/capability';
import { outcomeWords, statusWords } from '../format/status';
import { fieldsOf, holdAll, wordsOf } from './words';

/** What is looked for; empty texts ask for nothing. Times are of the operator's zone, as a `datetime-local` gives them. */
export interface Wanted {
  /** Words that all have to be there. */
  text: string;
  kind: string;
  actor: string;
  invocation: string;
  capability: string;
  since: string;
  until: string;
}

export const NOTHING_WANTED: Wanted = { text: '', kind: '', actor: '', invocation: '', capability: '', since: '', until: '' };

export const KINDS: readonly string[] = [
  'proposal', 'admission', 'policy', 'escalation', 'approval', 'authorization', 'launch', 'alert', 'intervention', 'recovery',
  'human', 'grant', 'review', 'telemetry', 'outcome', 'status', 'policy_activated', 'profile_changed', 'principal', 'cell', 'boot',
];

const PAGE = 200;
const PIECE = 40;
const WIDE_PAGE = 1000;
const MOST_PAGES = 20;
/** Each of them has the server read up to 50,000 events: a person who waits for no more than a moment is told how far it came. */
const SEARCHED_PAGES = 4;

/** A local time of the form's field as RFC 3339; null where it is none. */
export function instant(local: string): string | null {
  if (local === '') return null;
  const date = new Date(local);
  return Number.isNaN(date.getTime()) ? null : date.toISOString();
}

/** The log's own filters, from behind `from` on; the capability is no field of an event and is looked up by invocation. */
export function eventQuery(wanted: Wanted, from: number | null, limit: number, newestFirst: boolean): URLSearchParams {
  const query = new URLSearchParams({ order: newestFirst ? 'newest' : 'oldest', limit: String(limit) });
  if (from !== null) query.set(newestFirst ? 'before' : 'after', String(from));
  for (const name of ['text', 'kind', 'actor', 'invocation'] as const) {
    const value = wanted[name].trim();
    if (value !== '') query.set(name, value);
  }
  for (const name of ['since', 'until'] as const) {
    const at = instant(wanted[name]);
    if (at !== null) query.set(name, at);
  }
  return query;
}

/** Whether a session is among those looked for. Its proposer is its actor; its kinds are all of them. */
export function matches(session: Invocation, wanted: Wanted): boolean {
  const since = instant(wanted.since);
  const until = instant(wanted.until);
  return (
    session.id.includes(wanted.invocation.trim()) &&
    (wanted.capability === '' || session.capability === wanted.capability) &&
    (wanted.actor.trim() === '' || session.agent === wanted.actor.trim()) &&
    holds(session, wordsOf(wanted.text)) &&
    (since === null || Date.parse(session.updated_at) >= Date.parse(since)) &&
    (until === null || Date.parse(session.created_at) < Date.parse(until))
  );
}

/** What can be read of a session: its document, and the words in which it is told of. */
function sayings(session: Invocation): string[] {
  const { capability, effective, requested, status, outcome } = session;
  const told = [titleOf(capability, effective ?? requested), statusWords(status).text, outcome === null ? '' : outcomeWords(outcome)];
  return [...told, ...fieldsOf(session).flatMap(({ name, text }) => [name, text])];
}

function holds(session: Invocation, words: readonly string[]): boolean {
  return words.length === 0 || holdAll(sayings(session), words);
}

/** How many were looked at, and of when the last of them is. */
export interface Looked {
  count: number;
  at: string | null;
}

export const NOTHING_LOOKED_AT: Looked = { count: 0, at: null };

export function furtherBy(looked: Looked, more: Looked): Looked {
  return { count: looked.count + more.count, at: more.at ?? looked.at };
}

export interface Found<T> {
  items: T[];
  /** What continues; null at the end. */
  next: string | number | null;
  looked: Looked;
  /** Why it was looked for no further; empty where nothing was in the way. */
  why: string;
}

type Page<T> = Omit<Found<T>, 'why'>;

/** Page after page, until there is enough. Where one does not come, what those before it held is kept, and `next` asks for it again. */
async function paged<T>(from: Page<T>['next'], most: number, enough: number, read: (next: Page<T>['next']) => Promise<Page<T>>): Promise<Found<T>> {
  const items: T[] = [];
  let [next, looked] = [from, NOTHING_LOOKED_AT];
  for (let page = 0; page < most; page += 1) {
    try {
      const found = await read(next);
      items.push(...found.items);
      [next, looked] = [found.next, furtherBy(looked, found.looked)];
    } catch (error) {
      if (page === 0 || !(error instanceof ApiError)) throw error;
      return { items, next, looked, why: error.message };
    }
    if (next === null || items.length >= enough) break;
  }
  return { items, next, looked, why: '' };
}

/** Sessions, newest first. */
export async function findSessions(api: Pick<Api, 'invocations'>, wanted: Wanted, cursor: string | null, until?: AbortSignal): Promise<Found<Invocation>> {
  return paged<Invocation>(cursor, MOST_PAGES, 50, async (next) => {
    const query = new URLSearchParams({ limit: String(PAGE) });
    if (wanted.capability !== '') query.set('capability', wanted.capability);
    if (wanted.actor.trim() !== '') query.set('agent', wanted.actor.trim());
    if (next !== null) query.set('cursor', String(next));
    const found = await api.invocations(query, until);
    const looked = { count: found.items.length, at: found.items.at(-1)?.created_at ?? null };
    return { items: found.items.filter((session) => matches(session, wanted)), next: typeof found.next === 'string' ? found.next : null, looked };
  });
}

/** Returns what is listed, newest first, once its beginning was read anew: what was fetched behind that stays, as long as the two meet. */
export function renewed(listed: Page<Invocation>, beginning: Page<Invocation>): Page<Invocation> {
  const fresh = new Set(beginning.items.map(({ id }) => id));
  const meet = listed.items.findLastIndex(({ id }) => fresh.has(id));
  const behind = meet === -1 || beginning.next === null ? [] : listed.items.slice(meet + 1);
  return behind.length === 0 ? beginning : { items: [...beginning.items, ...behind], next: listed.next, looked: listed.looked };
}

/** The newer of what was found and what is known by now. */
export function newest(found: Invocation, known: Invocation | undefined): Invocation {
  return known !== undefined && Date.parse(known.updated_at) >= Date.parse(found.updated_at) ? known : found;
}

/** Returns what was found in pieces of an equal length, the last one apart. */
export function inPieces<T>(found: readonly T[], long = PIECE): T[][] {
  return Array.from({ length: Math.ceil(found.length / long) }, (_, k) => found.slice(k * long, (k + 1) * long));
}

/** Events by their place in the log, from behind `from` on, or from where it begins. */
export async function findEvents(api: Pick<Api, 'events' | 'invocations'>, wanted: Wanted, from: number | null, newestFirst: boolean, until?: AbortSignal): Promise<Found<LogEvent>> {
  const under = wanted.capability === '' ? null : await idsOf(api, wanted.capability, until);
  const pages = wanted.text.trim() === '' ? MOST_PAGES : SEARCHED_PAGES;
  return paged<LogEvent>(from, pages, PAGE, async (next) => {
    const found = await api.events(eventQuery(wanted, typeof next === 'number' ? next : null, under === null ? PAGE : WIDE_PAGE, newestFirst), until);
    const items = found.items.filter((event) => under === null || (event.invocation !== null && under.has(event.invocation)));
    return { items, next: typeof found.next === 'number' ? found.next : null, looked: lookedAt(found) };
  });
}

function lookedAt({ items, searched }: EventList): Looked {
  return searched === undefined ? { count: items.length, at: items.at(-1)?.at ?? null } : { count: searched.events, at: searched.at };
}

/** All of them, however many: one that is left out would hide its events without a word. */
async function idsOf(api: Pick<Api, 'invocations'>, capability: string, until?: AbortSignal): Promise<Set<string>> {
  const ids = new Set<string>();
  for (let cursor: string | null = ''; cursor !== null; ) {
    const query = new URLSearchParams({ capability, limit: String(PAGE) });
    if (cursor !== '') query.set('cursor', cursor);
    const { items, next } = await api.invocations(query, until);
    items.forEach((session) => ids.add(session.id));
    cursor = typeof next === 'string' ? next : null;
  }
  return ids;
}
