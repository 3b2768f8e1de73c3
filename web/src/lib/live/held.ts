import type { Cell, Escalation, LogEvent } from '../api/documents';
import { isNearness } from '../format/rules';

/** What letting a held session go on comes to right now: how the button reads, and what there is to know besides. */
export interface GoingOn {
  yes: string;
  note: string | null;
}

const PLAIN: GoingOn = { yes: 'Let it go on', note: null };
const WHEN_CLEAR = 'Go on once they have left';

/**
 * Says of a robot with a person near that it will wait. Only what is known is promised: that the rule pauses it is, where
 * it did so in this very session, and that it asks again, where it is the rule that asks.
 */
export function goingOn(asked: Pick<Escalation, 'invocation' | 'reasons'>, cell: Cell | null, events: readonly LogEvent[]): GoingOn {
  if (cell?.busy !== asked.invocation || cell.session?.violated.some(isNearness) !== true) return PLAIN;
  if (asked.reasons.some(({ code }) => isNearness(code))) {
    return { yes: WHEN_CLEAR, note: 'A person is still too near. Told to go on, the robot waits until they have left, and asks again if they stay.' };
  }
  const pauses = events.some(({ kind, invocation, body }) => kind === 'intervention' && invocation === asked.invocation && isNearness(body['rule']) && body['intervention'] === 'PAUSE');
  if (!pauses) return { ...PLAIN, note: 'A person is too near now.' };
  return { yes: WHEN_CLEAR, note: 'A person is too near now. Told to go on, the robot waits until they have left.' };
}

/** Whether a denial of the open question rolls the session back: then that is the answer, and no order beside it. */
export function deniedIsUndone(questions: readonly Escalation[], invocation: string | null): boolean {
  return questions.some((one) => one.invocation === invocation && one.status === 'pending' && one.kind !== 'approval' && one.on_deny === 'rollback');
}
