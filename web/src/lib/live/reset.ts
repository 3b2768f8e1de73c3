import type { LogEvent } from '../api/documents';

/** The second step out of a latched stop, as it was offered to this person. */
export interface Offered {
  code: string;
  /** When the first step was asked for, and until when the second counts: the server's wall clock. */
  sinceMs: number;
  untilMs: number;
}

/** Who pressed the stop that a cell is latched by, and when; null where the record of it is not here. */
export function stopOf(cell: string, events: readonly LogEvent[]): { by: string; at: string } | null {
  const words = events.filter(({ kind, body }) => kind === 'human' && body['cell'] === cell && (body['op'] === 'estop' || body['op'] === 'reset'));
  const first = words[words.findLastIndex(({ body }) => body['op'] === 'reset') + 1]; // whoever pressed it after them changed nothing
  return first === undefined ? null : { by: first.actor, at: first.at };
}

/** Whole seconds that are left to confirm. */
export function secondsLeft({ untilMs }: Offered, nowMs: number): number {
  return Math.max(0, Math.ceil((untilMs - nowMs) / 1000));
}

/** Why the second step may not be taken any more, in words; null while it may. */
export function whyWithdrawn(offered: Offered, cell: string, events: readonly LogEvent[], nowMs: number): string | null {
  const stop = events.findLast(({ kind, at, body }) => kind === 'human' && Date.parse(at) > offered.sinceMs && body['op'] === 'estop' && body['cell'] === cell);
  if (stop !== undefined) return `${stop.actor} has pressed the stop again since. Begin again once the cause is known.`;
  return offered.untilMs <= nowMs ? 'The time to confirm is over. Begin again.' : null;
}
