import type { Cell, Escalation, Grant, Invocation, LogEvent, Review } from '../api/documents';
import { entryOf } from '../format/entry';
import { waitingOf } from '../live/reviews';
import type { Changes } from '../socket/messages';

/** Everything the server has told this console, by id. A value: `merged` makes the next one. */
export interface Documents {
  seq: number;
  cells: Record<string, Cell>;
  invocations: Record<string, Invocation>;
  escalations: Record<string, Escalation>;
  grants: Record<string, Grant>;
  reviews: Record<string, Review>;
  /** How many wait, those included that are not among `reviews`. */
  reviewsWaiting: number;
  /** Oldest first. */
  events: LogEvent[];
}

export const EVENTS_KEPT = 1_000;
export const INVOCATIONS_KEPT = 200;
export const VERDICTS_KEPT = 100;
/** As many as the server tells of. */
export const WAITING_KEPT = 100;

export const NOTHING: Documents = { seq: 0, cells: {}, invocations: {}, escalations: {}, grants: {}, reviews: {}, reviewsWaiting: 0, events: [] };

/** Returns what a snapshot says; of what was known before, only events that it continues without a gap. */
export function fromSnapshot(snapshot: Changes, before: Documents): Documents {
  const first = snapshot.events?.[0]?.seq ?? snapshot.seq + 1;
  const last = before.events.at(-1)?.seq ?? 0;
  const joins = last > 0 && first <= last + 1 && snapshot.seq >= last;
  return merged({ ...NOTHING, events: joins ? before.events : [] }, snapshot);
}

/** Returns the documents with the newest versions in the place of older ones. */
export function merged(before: Documents, changes: Changes): Documents {
  return {
    seq: changes.seq,
    cells: without(put(before.cells, changes.cells), changes.cells_gone ?? []),
    invocations: newest(put(before.invocations, changes.invocations)),
    escalations: pendingOnly(put(before.escalations, changes.escalations)),
    grants: standing(put(before.grants, changes.grants)),
    reviews: judged(put(before.reviews, changes.reviews)),
    reviewsWaiting: changes.reviews_waiting ?? before.reviewsWaiting,
    events: appended(before.events, changes.events),
  };
}

function put<T extends { id: string }>(before: Record<string, T>, changed: readonly T[] | undefined): Record<string, T> {
  if (changed === undefined || changed.length === 0) return before;
  return { ...before, ...Object.fromEntries(changed.map((item) => [item.id, item])) };
}

function without<T>(all: Record<string, T>, gone: readonly string[]): Record<string, T> {
  return gone.length === 0 ? all : Object.fromEntries(Object.entries(all).filter(([name]) => !gone.includes(name)));
}

/** An answered question waits for nobody; its invocation still tells what became of it. */
function pendingOnly(all: Record<string, Escalation>): Record<string, Escalation> {
  return only(all, (item) => item.status === 'pending');
}

/** A grant that has ended answers for nobody any more. */
function standing(all: Record<string, Grant>): Record<string, Grant> {
  return only(all, (item) => item.status === 'active');
}

/** What is judged first is kept until it has its verdict; of those that have one, the newest. */
function judged(all: Record<string, Review>): Record<string, Review> {
  const beyond = Object.keys(all).length <= WAITING_KEPT ? [] : waitingOf(all).slice(WAITING_KEPT);
  const near = beyond.length === 0 ? all : only(all, (item) => !beyond.includes(item)); // the server tells of them again in time
  return bounded(near, (item) => item.status === 'waiting', (item) => item.verdict?.at ?? item.created_at, VERDICTS_KEPT);
}

/** What is not over is kept whatever comes after it: no flood of refusals hides the session that runs. */
function newest(all: Record<string, Invocation>): Record<string, Invocation> {
  return bounded(all, (item) => item.outcome === null, (item) => item.created_at, INVOCATIONS_KEPT);
}

function only<T>(all: Record<string, T>, wanted: (item: T) => boolean): Record<string, T> {
  const items = Object.entries(all);
  const left = items.filter(([, item]) => wanted(item));
  return left.length === items.length ? all : Object.fromEntries(left);
}

/** Keeps what is open, and of the rest the newest, `most` of them. Times are ISO 8601 in UTC: their text has their order. */
function bounded<T>(all: Record<string, T>, open: (item: T) => boolean, at: (item: T) => string, most: number): Record<string, T> {
  const items = Object.entries(all);
  const over = items.filter(([, item]) => !open(item));
  if (over.length <= most) return all;
  over.sort(([, a], [, b]) => (at(a) < at(b) ? 1 : -1));
  const dropped = new Set(over.slice(most).map(([id]) => id));
  return Object.fromEntries(items.filter(([id]) => !dropped.has(id)));
}

function appended(before: LogEvent[], more: readonly LogEvent[] | undefined): LogEvent[] {
  if (more === undefined || more.length === 0) return before;
  const last = before.at(-1)?.seq ?? 0;
  const fresh = more.filter((event) => event.seq > last);
  return fresh.length === 0 ? before : [...before, ...fresh].slice(-EVENTS_KEPT);
}

/** A grant by its id, from the log where it has ended. */
export function grantOf({ grants, events }: Documents, id: string): Grant | null {
  const said = entryOf(grants, id) ?? events.findLast((event) => event.kind === 'grant' && (event.body['grant'] as Partial<Grant> | undefined)?.id === id)?.body['grant'];
  return said === undefined ? null : (said as Grant);
}
