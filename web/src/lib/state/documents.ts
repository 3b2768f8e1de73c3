import type { Cell, Escalation, Grant, Invocation, LogEvent, Review } from '../api/documents';
import type { Changes } from '../socket/messages';

/** Everything the server has told this console, by id. A value: `merged` makes the next one. */
export interface Documents {
  seq: number;
  cells: Record<string, Cell>;
  invocations: Record<string, Invocation>;
  escalations: Record<string, Escalation>;
  grants: Record<string, Grant>;
  reviews: Record<string, Review>;
  /** Oldest first. */
  events: LogEvent[];
}

export const EVENTS_KEPT = 1_000;
export const INVOCATIONS_KEPT = 200;

export const NOTHING: Documents = { seq: 0, cells: {}, invocations: {}, escalations: {}, grants: {}, reviews: {}, events: [] };

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
    cells: put(before.cells, changes.cells),
    invocations: newest(put(before.invocations, changes.invocations)),
    escalations: pendingOnly(put(before.escalations, changes.escalations)),
    grants: put(before.grants, changes.grants),
    reviews: put(before.reviews, changes.reviews),
    events: appended(before.events, changes.events),
  };
}

function put<T extends { id: string }>(before: Record<string, T>, changed: readonly T[] | undefined): Record<string, T> {
  if (changed === undefined || changed.length === 0) return before;
  return { ...before, ...Object.fromEntries(changed.map((item) => [item.id, item])) };
}

/** An answered question waits for nobody; its invocation still tells what became of it. */
function pendingOnly(all: Record<string, Escalation>): Record<string, Escalation> {
  const items = Object.entries(all);
  const open = items.filter(([, item]) => item.status === 'pending');
  return open.length === items.length ? all : Object.fromEntries(open);
}

function newest(all: Record<string, Invocation>): Record<string, Invocation> {
  const items = Object.entries(all);
  if (items.length <= INVOCATIONS_KEPT) return all;
  items.sort(([, a], [, b]) => b.created_at.localeCompare(a.created_at));
  return Object.fromEntries(items.slice(0, INVOCATIONS_KEPT));
}

function appended(before: LogEvent[], more: readonly LogEvent[] | undefined): LogEvent[] {
  if (more === undefined || more.length === 0) return before;
  const last = before.at(-1)?.seq ?? 0;
  const fresh = more.filter((event) => event.seq > last);
  return fresh.length === 0 ? before : [...before, ...fresh].slice(-EVENTS_KEPT);
}
