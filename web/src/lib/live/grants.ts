import type { Offer } from '../api/client';
import type { Escalation, Grant } from '../api/documents';
import { words } from '../format/capability';
import { entryOf } from '../format/entry';
import { GRANT_ENDS } from '../format/events';
import { inBrief, plain } from '../format/plain';
import { clockTime } from '../format/time';

/** Whether a grant could have spared this question: only where nothing asks but the profile itself. What a rule escalates, it always asks. */
export function spares({ reasons }: Pick<Escalation, 'reasons'>): boolean {
  return reasons.every(({ code }) => code === 'approval_required');
}

/** All that a standing grant is bound to but its time, profile and policy. */
export type Cover = Pick<Grant, 'capability' | 'agent' | 'cell' | 'scope' | 'object' | 'task'>;

/** What a standing grant covers, whole: `every “grasp object” by planner in workcell-1`. */
export function coverOf({ capability, agent, cell, scope, object, task }: Cover): string {
  const named = `“${words(capability).toLowerCase()}”`;
  const which = { time: `every ${named}`, object: `${named} of ${plain(object ?? 'one object')}`, task: `${named} for its task${task === null ? '' : ` “${apart(task)}”`}` };
  return `${which[scope]} by ${plain(agent)} in ${plain(cell)}`;
}

/** What became of a standing grant, and when: `every “grasp object” by planner in workcell-1 (10:00:02, revoked by bob)`. */
export function endOf(grant: Grant): string {
  const { code, by, at } = grant.ended ?? { code: '', by: '', at: '' };
  const how = code === 'revoked' ? `revoked by ${by}` : (entryOf(GRANT_ENDS, code) ?? 'ended');
  return `${coverOf(grant)} (${clockTime(at)}, ${how})`;
}

/** Whether what is offered names another object than what the gripper holds by now: nobody allows what they do not read. */
export function another(offer: Offer | null, object: string | null): boolean {
  return offer?.object !== undefined && offer.object !== object;
}

/** Words of an agent's own within ours, where no element can set them apart: isolates do (Unicode UAX 9, 2.4.2). */
function apart(said: string): string {
  return `\u2068${inBrief(said)}\u2069`;
}
