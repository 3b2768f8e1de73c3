import type { Api } from '../api/client';
import type { Invocation, LogEvent } from '../api/documents';

/** What is looked for; empty texts ask for nothing. Times are of the operator's zone, as a `datetime-local` gives them. */
export interface Wanted {
  kind: string;
  actor: string;
  invocation: string;
  capability: string;
  since: string;
  until: string;
}

export const NOTHING_WANTED: Wanted = { kind: '', actor: '', invocation: '', capability: '', since: '', until: '' };

export const KINDS: readonly string[] = [
  'proposal', 'admission', 'policy', 'escalation', 'approval', 'authorization', 'launch', 'alert', 'intervention', 'recovery',
  'human', 'grant', 'review', 'telemetry', 'outcome', 'status', 'policy_activated', 'profile_changed', 'principal', 'cell', 'boot',
];

const PAGE = 200;
const WIDE_PAGE = 1000;
const MOST_PAGES = 20;

/** A local time of the form's field as RFC 3339; null where it is none. */
export function instant(local: string): string | null {
  if (local === '') return null;
  const date = new Date(local);
  return Number.isNaN(date.getTime()) ? null : date.toISOString();
}

/** The log's own filters; the capability is no field of an event and is looked up by invocation. */
export function eventQuery(wanted: Wanted, after: number, limit: number): URLSearchParams {
  const query = new URLSearchParams({ after: String(after), limit: String(limit) });
  for (const name of ['kind', 'actor', 'invocation'] as const) {
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
    (since === null || Date.parse(session.updated_at) >= Date.parse(since)) &&
    (until === null || Date.parse(session.created_at) < Date.parse(until))
  );
}

export interface Found<T> {
  items: T[];
  /** What continues; null at the end. */
  next: string | number | null;
}

/** Sessions, newest first. */
export async function findSessions(api: Pick<Api, 'invocations'>, wanted: Wanted, cursor: string | null): Promise<Found<Invocation>> {
  const items: Invocation[] = [];
  let next = cursor;
  for (let page = 0; page < MOST_PAGES; page += 1) {
    const query = new URLSearchParams({ limit: String(PAGE) });
    if (wanted.capability !== '') query.set('capability', wanted.capability);
    if (wanted.actor.trim() !== '') query.set('agent', wanted.actor.trim());
    if (next !== null) query.set('cursor', next);
    const found = await api.invocations(query);
    items.push(...found.items.filter((session) => matches(session, wanted)));
    next = typeof found.next === 'string' ? found.next : null;
    if (next === null || items.length >= 50) break;
  }
  return { items, next };
}

/** Returns what is listed, newest first, once its beginning was read anew: what was fetched behind that stays, as long as the two meet. */
export function renewed(listed: Found<Invocation>, beginning: Found<Invocation>): Found<Invocation> {
  const fresh = new Set(beginning.items.map(({ id }) => id));
  const meet = listed.items.findLastIndex(({ id }) => fresh.has(id));
  const behind = meet === -1 || beginning.next === null ? [] : listed.items.slice(meet + 1);
  return behind.length === 0 ? beginning : { items: [...beginning.items, ...behind], next: listed.next };
}

/** The newer of what was found and what is known by now. */
export function newest(found: Invocation, known: Invocation | undefined): Invocation {
  return known !== undefined && Date.parse(known.updated_at) >= Date.parse(found.updated_at) ? known : found;
}

/** Events in the log's order. */
export async function findEvents(api: Pick<Api, 'events' | 'invocations'>, wanted: Wanted, after: number): Promise<Found<LogEvent>> {
  const under = wanted.capability === '' ? null : await idsOf(api, wanted.capability);
  const items: LogEvent[] = [];
  let next: number | null = after;
  for (let page = 0; page < MOST_PAGES && next !== null && items.length < PAGE; page += 1) {
    const found = await api.events(eventQuery(wanted, next, under === null ? PAGE : WIDE_PAGE));
    items.push(...found.items.filter((event) => under === null || (event.invocation !== null && under.has(event.invocation))));
    next = typeof found.next === 'number' ? found.next : null;
  }
  return { items, next };
}

/** All of them, however many: one that is left out would hide its events without a word. */
async function idsOf(api: Pick<Api, 'invocations'>, capability: string): Promise<Set<string>> {
  const ids = new Set<string>();
  for (let cursor: string | null = ''; cursor !== null; ) {
    const query = new URLSearchParams({ capability, limit: String(PAGE) });
    if (cursor !== '') query.set('cursor', cursor);
    const { items, next } = await api.invocations(query);
    items.forEach((session) => ids.add(session.id));
    cursor = typeof next === 'string' ? next : null;
  }
  return ids;
}
