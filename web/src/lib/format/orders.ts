/** What people, cells and the server say by one word each, as an operator would say it. */
import { entryOf } from './entry';

const spaced = (word: string): string => word.replaceAll('_', ' ');
const from =
  (table: Readonly<Record<string, string>>) =>
  (word: string): string =>
    entryOf(table, word) ?? spaced(word);

/** What somebody did, behind who it was. */
const ORDERS: Record<string, string> = {
  estop: 'pressed the emergency stop',
  reset: 'reset the stop, nothing moved',
  pause: 'paused the session',
  resume: 'let the session go on',
  stop: 'stopped the session',
  rollback: 'ordered a rollback',
  cancel: 'cancelled the session',
  takeover: 'took the controls',
  release: 'handed the controls back',
  acknowledge: 'has seen the question',
  let_go: 'is at rest again',
  end_takeover: 'ended the session that was driven by hand',
  confirm: 'goes on, as a person confirmed',
  control_lapsed: 'ended the lease: its holder fell silent',
  control_withdrawn: 'ended the lease: policy lets nobody drive',
};

/** A person's word, or a decision of theirs; of what has no words here, the word itself. */
export const orderWords = (op: string): string => entryOf(ORDERS, op) ?? `said ${spaced(op)}`;

/** What a cell was told, behind “obeys:” and “does not obey:”. */
const TOLD: Record<string, string> = {
  estop: 'emergency stop',
  reset: 'reset of the stop',
  jog: 'drive by hand',
  let_go: 'come to rest',
  end_takeover: 'end what was driven by hand',
  confirm: 'go on, as a person confirmed',
  resolve_continue: 'go on, as a person answered',
  resolve_terminate: 'end it, as a person answered',
  escalate: 'ask a person, as policy has changed',
};
const UNANSWERED: Record<string, string> = { resolve_terminate: 'end it, as nobody answered in time', rollback: 'rollback, as nobody answered in time' };

export const toldWords = (op: string, unanswered: boolean): string => entryOf(unanswered ? UNANSWERED : TOLD, op) ?? from(TOLD)(op);

/** Why a cell does not do what it was told, or launches nothing. */
export const undoneWords = from({
  rollback_unavailable: 'there is nothing to go back to, or it was tried already',
  not_paused: 'it is not paused',
  not_escalated: 'it asks nothing',
  not_taken_over: 'nobody has the controls',
  not_latched: 'no stop is latched',
  no_such_session: 'it runs no such session any more',
  needs_authorization: 'it takes a new authorization',
  needs_confirmation: 'a person has to confirm first',
  ending: 'it is coming to its end',
  returning: 'the controls are being handed back',
  paused: 'it is paused',
  holding: 'it holds, and moves nothing',
  broken_since: 'what guards it broke meanwhile',
  unknown_op: 'it does not know the order',
  busy: 'it runs another session',
  blocked: 'the base has met something',
  unreachable: 'the arm does not reach there',
  separation: 'a person is too near',
  zone: 'a forbidden zone is too near',
  estop_latched: 'an emergency stop is latched',
  journal_unavailable: 'it cannot write its journal',
  another_site: 'the robot works by another site than the policy; restart the cell',
  no_plan: 'it has no plan to watch it by',
  bad_signature: 'the authorization is not signed by this server',
  malformed: 'the authorization cannot be read',
  wrong_cell: 'the authorization is for another cell',
  wrong_policy: 'the authorization is under another policy',
  not_yet_valid: 'the authorization does not count yet',
  expired: 'the authorization came too late',
  clock_put_back: 'its clock was put back, and it cannot tell whether the authorization was used',
  used: 'the authorization was used already',
});

/** What is said of a cell itself: by it, or by the server. */
export const cellWords = from({
  broken: 'what guards it broke, and nothing moves',
  skill_error: 'the skill failed of itself',
  unprepared: 'the skill could not be prepared',
  no_plan: 'it has no plan to watch the session by',
  reset_refused: 'the stop stays latched',
  latched: 'the stop is latched',
  left_out: 'words of it are missing from the record',
  never_taken: 'it never came under the controls',
  not_sent: 'an order was recorded, and never sent to it',
});

/** What became of a version of policy. */
export const versionWords = from({
  refuted: 'its proofs are refuted',
  undecided: 'its proofs are not decided',
  offered: 'in the policy directory, and not in force',
  awaiting_second: 'waits for a second engineer',
});
