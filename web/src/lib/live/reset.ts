import type { Cell, LogEvent } from '../api/documents';

const CLOCKS_MS = 1_000;
/** What the server says of a second step that is none any more, where nothing else tells why. */
export const VOIDED = 'What you began is void: the stop was pressed again, or a reset begun or confirmed elsewhere since. Begin again.';

/** The second step out of a latched stop, as it was offered to this person. */
export interface Offered {
  by: string;
  code: string;
  /** When the first step was asked for, and until when the second counts: the server's wall clock. */
  sinceMs: number;
  untilMs: number;
}

/** Who pressed the stop that a cell is latched by, and when; null where the record of it is not here. */
export function stopOf(cell: string, events: readonly LogEvent[]): { by: string; at: string } | null {
  let stop: LogEvent | null = null;
  let left: LogEvent | null = null; // by the last reset
  for (const event of events.filter(({ body }) => body['cell'] === cell)) {
    if (isWord(event, 'estop')) stop ??= event; // whoever presses it after them changes nothing
    else if (isWord(event, 'reset')) [stop, left] = [null, stop];
    else if (isUnheard(event)) stop ??= left;
    else if (isLeft(event)) stop = null;
  }
  return stop === null ? null : { by: stop.actor, at: stop.at };
}

/** The stop of a cell that one does not look at. */
export interface StopElsewhere {
  cell: string;
  /** Whether the cell is heard: one that is not has confirmed nothing. */
  heard: boolean;
  /** Who pressed it, and when; null where the record of it is not here. */
  stop: { by: string; at: string } | null;
}

/** The cells that are stopped, but the one that is looked at: its own banner tells of that one. */
export function stoppedElsewhere(cells: readonly Cell[], here: string | null, events: readonly LogEvent[]): StopElsewhere[] {
  return cells.filter(({ id, latched }) => latched && id !== here).map(({ id, online }) => ({ cell: id, heard: online, stop: stopOf(id, events) }));
}

/**
 * Whether a stop is another one than was put away, by when it was pressed: a reset and the next stop may come together.
 * Undefined: none was put away. Null: when is not known, of either.
 */
export function isNews(stop: StopElsewhere['stop'], putAway: string | null | undefined): boolean {
  if (putAway === undefined) return true;
  return stop !== null && putAway !== null && stop.at !== putAway;
}

/** Whose reset the cell was not heard to have had, if that was the last word on its stop; null: nobody's. */
export function unheardOf(cell: string, events: readonly LogEvent[]): string | null {
  const words = events.filter((event) => event.body['cell'] === cell && (isWord(event, 'estop') || isWord(event, 'reset') || isUnheard(event) || isLeft(event)));
  const last = words.at(-1);
  return last !== undefined && isUnheard(last) ? (words.findLast((event) => isWord(event, 'reset'))?.actor ?? last.actor) : null;
}

/** The number in the record of this person's last stop of a cell; null where there is none. */
export function lastStopBy(name: string, cell: string, events: readonly LogEvent[]): number | null {
  return events.findLast((event) => event.actor === name && isWord(event, 'estop') && event.body['cell'] === cell)?.seq ?? null;
}

function isWord({ kind, body }: LogEvent, op: string): boolean {
  return kind === 'human' && body['op'] === op;
}

/** Whether an event says that a reset came to nothing: the cell was not heard to have had it. */
function isUnheard({ kind, body }: LogEvent): boolean {
  return kind === 'cell' && body['what'] === 'not_confirmed' && body['op'] === 'reset';
}

/** Whether an event says that the cell of such a reset has no stop all the same. */
function isLeft({ kind, body }: LogEvent): boolean {
  return kind === 'cell' && body['what'] === 'confirmed' && body['op'] === 'reset';
}

/** Whole seconds that are left to confirm. */
export function secondsLeft({ untilMs }: Offered, nowMs: number): number {
  return Math.max(0, Math.ceil((untilMs - nowMs) / 1000));
}

/** Who has pressed the stop since the second step was offered, in words; null where nobody has, or the record of it is not here yet. */
export function pressedAgain(offered: Offered, cell: string, events: readonly LogEvent[]): string | null {
  const stop = events.findLast((event) => isWord(event, 'estop') && Date.parse(event.at) > offered.sinceMs && event.body['cell'] === cell);
  return stop === undefined ? null : `${stop.actor} has pressed the stop again since. Begin again once the cause is known.`;
}

/** Why the second step may not be taken any more, in words; null while it may. `armedBy`: whose it is, null: nobody's. */
export function whyWithdrawn(offered: Offered, cell: string, events: readonly LogEvent[], nowMs: number, armedBy: string | null): string | null {
  const pressed = pressedAgain(offered, cell, events);
  if (pressed !== null) return pressed;
  // Its end is told by two clocks.
  if (offered.untilMs - (armedBy === null ? CLOCKS_MS : 0) <= nowMs) return 'The time to confirm is over. Begin again.';
  if (armedBy === offered.by) return null;
  return armedBy === null ? VOIDED : `${armedBy} has begun to reset it since, which voids what you began. Agree on who does it.`;
}
