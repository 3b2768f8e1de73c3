import type { Cell, Invocation } from '../api/documents';
import type { Tone } from '../format/status';

const OVER = new Set(['rejected', 'deferred', 'denied', 'completed', 'failed', 'awaiting_approval']);

/** Who moves the robot now: a person with the controls, the agent whose session runs, or nobody. */
export function inControl(cell: Cell | null, session: Invocation | null, me: string | null): { long: string; short: string; tone: Tone } {
  if (cell === null) return { long: '–', short: '–', tone: 'quiet' };
  if (cell.control != null) {
    const mine = cell.control.holder === me;
    return { long: mine ? `You (${cell.control.where})` : `${cell.control.holder} (${cell.control.where})`, short: mine ? 'you' : cell.control.holder, tone: 'human' };
  }
  if (session !== null && cell.busy === session.id && !OVER.has(session.status)) {
    return { long: `Agent “${session.agent}”`, short: session.agent, tone: 'plain' };
  }
  return { long: 'Nobody', short: 'nobody', tone: 'quiet' };
}
