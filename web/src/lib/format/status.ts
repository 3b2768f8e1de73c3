import type { Cell, Status } from '../api/documents';
import { entryOf } from './entry';

export type Tone = 'plain' | 'quiet' | 'ok' | 'warn' | 'danger' | 'human' | 'accent';

const STATUS: Record<Status, { text: string; tone: Tone }> = {
  rejected: { text: 'Rejected', tone: 'danger' },
  deferred: { text: 'Deferred', tone: 'quiet' },
  denied: { text: 'Denied', tone: 'danger' },
  awaiting_approval: { text: 'Waits for approval', tone: 'warn' },
  running: { text: 'Running', tone: 'plain' },
  paused: { text: 'Paused, holding', tone: 'danger' },
  escalated: { text: 'Held, asks a person', tone: 'warn' },
  recovering: { text: 'Recovering', tone: 'warn' },
  taken_over: { text: 'Driven by hand', tone: 'human' },
  completed: { text: 'Done', tone: 'ok' },
  failed: { text: 'Failed', tone: 'danger' },
};

export function statusWords(status: string): { text: string; tone: Tone } {
  return entryOf<{ text: string; tone: Tone }>(STATUS, status) ?? { text: status.replaceAll('_', ' '), tone: 'plain' };
}

/** Who sits here, as the console was told: `ann, operator`, or where they stand at a cell, `ann, operator at workcell-1`. */
export function whoWords({ name, role, station }: { name: string; role: string; station: string | null }): string {
  return `${name}, ${role}${station === null ? '' : ` at ${station}`}`;
}

/** What the robot reports of itself, the gravest thing first. */
export function robotSays(cell: Cell | null): { text: string; tone: Tone } {
  if (cell === null) return { text: 'No cell', tone: 'quiet' };
  const grave = graveOf(cell);
  if (grave !== null) return { text: grave, tone: 'danger' };
  if (cell.control != null) return { text: 'Driven by hand', tone: 'human', ...heldIn(cell) };
  if (cell.status === null || cell.busy === null) return { text: 'Idle', tone: 'plain' };
  return { ...statusWords(cell.status), ...(cell.status === 'paused' ? { tone: pausedTone(cell) } : {}) };
}

/** Who drives has to know that nothing moves. */
function heldIn(cell: Cell): { text?: string; tone?: Tone } {
  const { status } = cell;
  if (status === 'paused') return { text: 'Driven by hand, paused', tone: pausedTone(cell) };
  if (status === 'escalated') return { text: 'By hand, asks a person', tone: STATUS.escalated.tone };
  return {};
}

/** A person's own pause is no alarm; what the watcher holds is. */
function pausedTone({ session }: Cell): Tone {
  const by = session?.paused_by ?? [];
  return by.includes('operator') && !by.includes('watch') ? 'warn' : STATUS.paused.tone;
}

/** A cell that is not heard has not confirmed anything, a stop least of all. */
function graveOf(cell: Cell): string | null {
  if (!cell.online) return cell.latched ? 'Not heard, stop sent' : 'Not heard';
  if (cell.latched) return 'Stopped, latched';
  if (cell.holding_link) return 'Holding, link lapsed';
  return cell.fault != null && cell.status === null ? 'Launches nothing' : null;
}

const OUTCOMES: Record<string, string> = {
  succeeded: 'done, verified',
  recovered: 'done on a new attempt', // after a recovery, or after somebody drove by hand and handed back
  rolled_back: 'rolled back',
  terminated: 'terminated',
  stopped: 'stopped',
  cancelled: 'cancelled',
  taken_over: 'taken over',
  rejected: 'rejected',
  denied: 'denied',
  deferred: 'deferred',
  expired: 'expired',
  fault: 'fault',
};

export function outcomeWords(outcome: string): string {
  return entryOf(OUTCOMES, outcome) ?? outcome.replaceAll('_', ' ');
}

export function goodOutcome(outcome: string): boolean {
  return outcome === 'succeeded' || outcome === 'recovered';
}

const TONES: Record<string, Tone> = { succeeded: 'ok', recovered: 'ok', taken_over: 'human', cancelled: 'quiet', deferred: 'quiet', rolled_back: 'warn', expired: 'warn' };

/** How loudly an outcome speaks: red is for what was refused, stopped or broken. */
export function outcomeTone(outcome: string): Tone {
  return entryOf(TONES, outcome) ?? 'danger';
}

export function shortId(id: string): string {
  return id.length > 14 ? `${id.slice(0, 4)}…${id.slice(-6)}` : id;
}

const LONG_ID = /\b(inv|esc|grant|lease|rev)_[0-9A-Z]{20,}\b/g;

/** A text in which ids stand as they do everywhere else. */
export function withShortIds(text: string): string {
  return text.replace(LONG_ID, shortId);
}

/** The first digits of a digest: enough to tell two policies apart at a glance. */
export function shortDigest(digest: string | null): string {
  return digest === null ? '–' : digest.replace(/^sha256:/, '').slice(0, 7);
}
