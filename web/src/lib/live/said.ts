import type { Control, Invocation, LogEvent } from '../api/documents';
import { outcomeWords, statusWords } from '../format/status';
import { elapsed } from '../format/time';

/** How a session is getting on, in a few words: what came of it, or since when it waits, runs or is driven by hand; `control` is who has the controls of its cell. */
export function sessionSays(session: Invocation, events: readonly LogEvent[], nowMs: number, control: Pick<Control, 'invocation' | 'since'> | null = null): string {
  if (session.outcome !== null) return outcomeWords(session.outcome);
  if (control?.invocation === session.id) return `${elapsed(nowMs - Date.parse(control.since))} driven by hand`;
  const state = statusWords(session.status).text.toLowerCase();
  const since = session.status === 'awaiting_approval' ? session.created_at : launchOf(session, events)?.at;
  // Of what was launched before this console can look back, it is not known for how long it has run.
  return since === undefined ? state : `${elapsed(nowMs - Date.parse(since))} ${state}`;
}

function launchOf({ id }: Invocation, events: readonly LogEvent[]): LogEvent | undefined {
  return events.find(({ kind, invocation, body }) => kind === 'launch' && invocation === id && !('refused' in body));
}
