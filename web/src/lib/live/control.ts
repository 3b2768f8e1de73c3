import type { Cell, Control, Invocation, LogEvent } from '../api/documents';
import { entryOf } from '../format/entry';
import { isNearness } from '../format/rules';
import type { Tone } from '../format/status';

const OVER = new Set(['rejected', 'deferred', 'denied', 'completed', 'failed', 'awaiting_approval']);

interface Driver {
  long: string;
  short: string;
  tone: Tone;
}

export const DRIVER_UNKNOWN: Driver = { long: 'Not known', short: 'not known', tone: 'quiet' };

/** Who moves the robot now: a person with the controls, the agent whose session runs, or nobody; not known of a cell that is not heard. */
export function inControl(cell: Cell | null, session: Invocation | null, me: string | null): Driver {
  if (cell === null) return { long: '–', short: '–', tone: 'quiet' };
  if (!cell.online) return DRIVER_UNKNOWN;
  if (cell.control != null) {
    const mine = cell.control.holder === me;
    return { long: mine ? `You (${cell.control.where})` : `${cell.control.holder} (${cell.control.where})`, short: mine ? 'you' : cell.control.holder, tone: 'human' };
  }
  if (session !== null && cell.busy === session.id && !OVER.has(session.status)) {
    return { long: `Agent “${session.agent}”`, short: session.agent, tone: 'plain' };
  }
  return { long: 'Nobody', short: 'nobody', tone: 'quiet' };
}

/** Why approving a proposal now would use it up for nothing: what is in the way on its cell or, where it may go to any, on each of them. */
export function inVainOn(cells: readonly Cell[], asked: { cell?: string | null | undefined; invocation: string }): string | null {
  const found = cells.filter(({ id }) => asked.cell == null || id === asked.cell).map((cell) => inTheWay(cell, asked.invocation));
  return found.includes(null) ? null : (found[0] ?? null);
}

function inTheWay({ id, latched, busy, control }: Cell, invocation: string): string | null {
  if (latched) return `${id} is stopped and would refuse it: reset the stop before you approve`;
  if (control != null) return `${id} is driven by hand and would defer it: approve once the controls are given back`;
  if (busy !== null && busy !== invocation) return `${id} is busy with another session and would defer it: approve once that is over`;
  return null;
}

/** In whose hands the controls are: nobody's, this window's, mine in another window, or somebody else's. */
export type Hands = 'free' | 'here' | 'elsewhere' | 'other';

export function handsOn(cell: Cell | null, me: string | null, lease: string | null): Hands {
  const control = cell?.control ?? null;
  if (control === null) return 'free';
  if (control.holder !== me) return 'other';
  return control.lease === lease ? 'here' : 'elsewhere';
}

/**
 * Returns the lease that a refusal is said of, null where nobody has the controls. Mine in no window that shows it may be
 * what was just asked for: a page sees that for a moment while the server still decides, and goes on without it.
 */
export function standingLease(cell: Cell | null, hands: Hands): string | null {
  return hands === 'elsewhere' ? null : (cell?.control?.lease ?? null);
}

/** Whether what a refusal was said of is over: the session that ran then, or, where none did, the cell that was idle. */
export function isPast(ran: string | null, { busy, control }: Pick<Cell, 'busy' | 'control'>): boolean {
  return busy !== ran && (ran !== null || control == null);
}

/** Why nothing that is pressed reaches the robot, in words; null where it may be taken that it does. */
export function unreachedWords({ live, cell }: { live: boolean; cell: Pick<Cell, 'id' | 'online'> | null }): string | null {
  if (!live) return 'the link is down or too slow';
  return cell?.online === true ? null : `${cell?.id ?? 'the cell'} is not heard`;
}

/** What has the server take the controls out of somebody's hands. */
const TAKEN_AWAY: Record<string, string> = {
  control_lapsed: 'Nothing was heard from this window for three seconds, so the robot came to rest.',
  control_withdrawn: 'Another policy came into force that lets nobody drive: the robot came to rest.',
};
const CUT = 'The cell had lost the server: the robot came to rest, and what you drove is over.';
/** What the banners of a stop and of a cell's fault tell already. */
const TOLD = new Set(['estop', 'guard_broken', 'loop_broken', 'not_held']);

/**
 * Why the controls that were had by this lease are lost, in words: whatever took them, but what its holder or another
 * holder did. Null where that is not known, as of a lease that was given back, or not yet taken.
 */
export function lossOf(events: readonly LogEvent[], lease: string | null): string | null {
  if (lease === null) return null;
  const [taken] = events.map((event) => takenAway(event, lease)).filter((words) => words !== null);
  if (taken !== undefined) return taken;
  const at = events.findLastIndex((event) => isTaking(event) && event.body['lease'] === lease);
  const since = at === -1 ? [] : events.slice(at + 1).filter(({ invocation }) => invocation === events[at]?.invocation);
  if (since.some(isTaking) || isGivenBack(since)) return null;
  const end = since.find(({ kind }) => kind === 'outcome');
  return end === undefined ? heldWords(since) : endWords(end.body['code'], since);
}

/** Whether they were handed back, and that was not refused: then their holder kept them. */
function isGivenBack(since: readonly LogEvent[]): boolean {
  const at = since.findLastIndex(({ kind, body }) => kind === 'human' && body['op'] === 'release');
  return at !== -1 && !since.slice(at + 1).some(isRefusal);
}

function isRefusal({ kind, body }: LogEvent): boolean {
  if (kind === 'launch') return 'refused' in body;
  return kind === 'cell' ? body['what'] === 'not_sent' : kind === 'human' && body['op'] === 'rollback' && body['done'] === false;
}

/** Of a session that was taken out of somebody's hands and has not ended: its cell's own report says that it waits, or never let them have it. */
function heldWords(since: readonly LogEvent[]): string | null {
  const [first] = since.filter(({ kind }) => kind === 'launch');
  if (first !== undefined && 'refused' in first.body) return 'The cell did not let itself be driven.';
  if (!since.some(({ kind, body }) => kind === 'escalation' && 'reason' in body)) return null;
  const changed = since.some(({ kind, body }) => kind === 'intervention' && 'former' in body && body['intervention'] === 'ESCALATE');
  return `${changed ? 'Another policy came into force: the' : 'The'} robot came to rest, and the session waits for a person.`;
}

function endWords(said: LogEvent['body'][string] | undefined, since: readonly LogEvent[]): string | null {
  const code = typeof said === 'string' ? said : '';
  if (TOLD.has(code)) return null;
  if (code === 'link') return CUT;
  const word = since.findLast(({ kind, body }) => kind === 'human' && 'role' in body && (body['op'] === 'stop' || body['op'] === 'cancel'));
  return word === undefined ? `What you drove is over: ${code.replaceAll('_', ' ')}.` : `${word.actor} ended what was driven.`;
}

/** Why the server took the controls out of the hands that had them by this lease, if that is what an event says. */
function takenAway({ kind, body }: LogEvent, lease: string): string | null {
  const op = body['op'];
  return kind === 'human' && typeof op === 'string' && body['lease'] === lease ? (entryOf(TAKEN_AWAY, op) ?? null) : null;
}

function isTaking({ kind, body }: LogEvent): boolean {
  return kind === 'human' && body['op'] === 'takeover';
}

const WHY: Record<string, string> = {
  not_holder: 'you do not have the controls any more',
  lease_lapsed: 'nothing was heard from you for three seconds',
  returning: 'the cell is being handed back',
  out_of_order: 'another window of yours drives, too',
  too_late: 'the line is too slow to drive by: what you press comes late',
  cell_offline: 'the cell is not attached',
  coming_to_rest: 'it is still coming to rest',
  release_first: 'let go of everything, then press again',
  paused: 'the session is paused',
  holding: 'the cell holds, its link was away',
  unreachable: 'the arm does not reach there',
  blocked: 'the base has met something; let go, then drive away from it',
  zone: 'a forbidden zone is too near',
  stale: 'a sensor is silent',
};

/** Who holds a paused session; both do where somebody pauses what the watcher holds already. */
export interface Holders {
  operator: boolean;
  watch: boolean;
}

export function holdersOf(cell: Cell | null): Holders {
  if (cell?.status !== 'paused') return { operator: false, watch: false };
  const by = cell.session?.paused_by ?? [];
  return { operator: by.includes('operator'), watch: by.includes('watch') };
}

/**
 * Whether a session may be paused, and whether resumed. What only the watcher holds goes on by itself: it can be
 * paused, so that it stays, and there is nothing to resume. Until its cell says who holds it, pausing is no mistake.
 */
export function restraintsOf(status: string | null, { operator }: Holders): { pausable: boolean; resumable: boolean } {
  if (status === 'running' || status === 'recovering') return { pausable: true, resumable: false };
  if (status !== 'paused') return { pausable: false, resumable: false };
  return { pausable: !operator, resumable: operator };
}

/** Who paused a session last, as the record says it: the server notes a person's word with their role, the cell only its echo. */
export function pauserOf(events: readonly LogEvent[], invocation: string | null): string | null {
  return pauseOf(events, invocation)?.actor ?? null;
}

/** The newest pause of a session, as the record has it: the one that a resume would end. */
export function pauseOf(events: readonly LogEvent[], invocation: string | null): LogEvent | null {
  return events.findLast((event) => event.kind === 'human' && event.invocation === invocation && event.body['op'] === 'pause' && 'role' in event.body) ?? null;
}

/** Whose pause ended when somebody took the controls, for who drives and who paused; null where none stood then. */
export function pauseEndedOf(events: readonly LogEvent[], control: Pick<Control, 'lease' | 'invocation'> | null): string | null {
  const words = events.filter(({ kind, invocation, body }) => kind === 'human' && invocation === control?.invocation && 'role' in body);
  const at = words.findIndex(({ body }) => body['op'] === 'takeover' && body['how'] === 'granted' && body['lease'] === control?.lease);
  if (at === -1 || words[at]?.body['status'] !== 'paused') return null;
  const last = words.slice(0, at).findLast(({ body }) => body['op'] === 'pause' || body['op'] === 'resume');
  return last?.body['op'] === 'pause' ? last.actor : null;
}

/** Why nothing moves in a session that is paused, and whether a person may resume it; null where none is. */
export function pausedWords(cell: Cell | null, pauser: string | null = null): { why: string; resumable: boolean } | null {
  if (cell?.status !== 'paused') return null;
  if (holdersOf(cell).operator) return { why: `${pauser ?? 'somebody'} paused the session`, resumable: true };
  const { violated = [] } = cell.session ?? {};
  return { why: violated.map(refusalWords).join(', ') || 'the watcher stopped it', resumable: false };
}

/** Why a command of somebody who drives is not obeyed, in words; a rule without any is named. */
export function refusalWords(code: string): string {
  const rule = code.split('/').at(-1) ?? code;
  if (isNearness(rule)) return 'a person is too near';
  return entryOf(WHY, rule) ?? `stopped by ${rule.replaceAll('_', ' ')}`;
}
