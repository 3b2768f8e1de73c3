import type { Escalation, Invocation, Json, LogEvent } from '../api/documents';
import { titleOf } from '../format/capability';
import { eventLine } from '../format/events';
import { plain } from '../format/plain';
import { outcomeWords } from '../format/status';
import { clockTime } from '../format/time';
import type { Lapse } from '../state/lapses.svelte';

export type Asked = Pick<Escalation, 'id' | 'invocation'>;

/** How a question ended that is not open any more. */
export interface Closing {
  /** As a sentence; null where nothing is known of it. */
  words: string | null;
  /** Who approved it did so for nothing: it was refused, deferred, denied or withdrawn all the same. */
  inVain: boolean;
  /** Its time ran out. */
  lapsed: boolean;
}

/** What withdraws a question: the word of somebody who decides otherwise than by an answer. */
const INSTEAD: Record<string, string> = {
  rollback: 'ordered a rollback',
  takeover: 'took over',
  cancel: 'cancelled it',
  stop: 'stopped it',
  estop: 'pressed the emergency stop',
};

const text = (value: Json | undefined): string => (typeof value === 'string' ? value : '');
const record = (value: Json | undefined): Record<string, Json> => (typeof value === 'object' && value !== null && !Array.isArray(value) ? value : {});
const question = (event: LogEvent): Record<string, Json> => record(event.body['escalation']);
const idOf = (event: LogEvent): string => text(question(event)['id']);
const firstReason = (event: LogEvent): Record<string, Json> => record(Array.isArray(event.body['reasons']) ? event.body['reasons'][0] : undefined);

/** Who reads of what they did themselves is not told their own name. */
type Naming = (actor: string) => string;

/** Says how a question ended, as the record has it; `invocation` is what it was about, as far as that is known, `me` whoever reads. */
export function closingOf(events: readonly LogEvent[], asked: Asked, invocation: Invocation | null, me: string | null = null): Closing {
  const named: Naming = (actor) => (actor === me ? 'you' : actor);
  const told = events.filter((event) => idOf(event) === asked.id);
  const last = told.findLast((event) => question(event)['status'] !== 'pending');
  const over = invocation?.outcome == null ? null : 'It is over.';
  // What its cell withdraws is not recorded as an answer: whose word it was is.
  const word = last === undefined ? instead(events, asked, told[0], named) : null;
  if (last === undefined) return { words: word ?? over, inVain: word !== null, lapsed: false };
  if (question(last)['status'] === 'approved') return approved(events, asked, last, named);
  return { words: unapproved(events, asked, { from: told[0], last }, named) ?? over ?? 'It was withdrawn.', inVain: true, lapsed: question(last)['status'] === 'expired' };
}

/** Says how a question ended of whose end nothing is known: a cell withdraws what it asked, but of one whose record is not here anything may have come. */
export function endWords(events: readonly LogEvent[], asked: Asked): string {
  return events.some((event) => idOf(event) === asked.id) ? 'It was withdrawn.' : 'Audit tells what became of it.';
}

/** Whether anybody said something to a question, whatever became of it: an approval may count no more by the end. */
function heard(events: readonly LogEvent[], { id }: Pick<Escalation, 'id'>): boolean {
  return events.some((event) => event.kind === 'approval' && idOf(event) === id);
}

/** Says what lapsed, and where, if there are several cells. What the gripper held then, nobody knows by now. */
export function lapseWords({ asked, at }: Lapse, several: boolean, events: readonly LogEvent[] = []): string {
  const { approvals, needed, cell } = asked;
  const where = several && cell != null ? ` in ${cell}` : '';
  const given = approvals.length === 0 && !heard(events, asked) ? 'nobody answered' : `${approvals.length} of ${needed} approved`;
  return `${titleOf(asked.capability, asked.effective, 'what it held')}${where} (${clockTime(at)}, ${given})`;
}

function first(name: string): string {
  return name === 'you' ? 'You' : name;
}

function unapproved(events: readonly LogEvent[], asked: Asked, { from, last }: { from: LogEvent | undefined; last: LogEvent }, named: Naming): string | null {
  if (question(last)['status'] === 'denied') return `${first(named(last.actor))} ${refusedWords(question(last))}.`;
  if (question(last)['status'] === 'expired') return unanswered(question(last), heard(events, asked));
  return instead(events, asked, from, named, last.seq) ?? renewed(events, asked, last, named);
}

/** What a denial came to: of what has begun it is no denial that is pressed, but its end. */
function refusedWords({ kind, on_deny: then }: Record<string, Json>): string {
  if (kind === undefined || kind === 'approval') return 'denied';
  return then === 'rollback' ? 'had it rolled back' : 'ended it';
}

/** Whose answers were missing when the time was over. */
function unanswered({ approvals, needed }: Record<string, Json>, answered: boolean): string {
  const [given, wanted] = [Array.isArray(approvals) ? approvals.length : 0, typeof needed === 'number' ? needed : 1];
  if (given === 0) return answered ? `0 of ${wanted} approved when the time was over.` : 'Nobody answered in time.';
  const missing = given + 1 < wanted ? 'the others' : wanted === 2 ? 'the second' : 'the last one';
  return `${given} of ${wanted} approved; ${missing} did not answer in time.`;
}

/** Whose word withdrew a question: of those from where it was first asked on, until it ended, or the next one was asked. */
function instead(events: readonly LogEvent[], asked: Asked, from: LogEvent | undefined, named: Naming, until?: number): string | null {
  const about = events.filter((event) => event.invocation === asked.invocation && event.seq > (from?.seq ?? 0));
  const next = about.find((event) => !['', asked.id].includes(idOf(event)));
  const before = until ?? next?.seq ?? Infinity;
  const word = about.findLast((event) => event.kind === 'human' && event.seq < before && 'role' in event.body && Object.hasOwn(INSTEAD, text(event.body['op'])));
  return word === undefined ? null : `It was withdrawn: ${named(word.actor)} ${INSTEAD[text(word.body['op'])]}.`;
}

/** What withdrew a question that nobody's word was about, and what came of that: it was decided again, under another policy or profile. */
function renewed(events: readonly LogEvent[], asked: Asked, last: LogEvent, named: Naming): string | null {
  const { renewed: why, cell } = question(last);
  const came = cameOf(followingOf(events, asked, last));
  if (why === 'policy_changed') return `It was withdrawn: another policy came into force.${came}`;
  if (why !== 'profile_changed') return null;
  const change = events.findLast((event) => event.kind === 'profile_changed' && event.body['cell'] === cell && event.seq < last.seq);
  return `It was withdrawn: ${change === undefined ? 'the cell was put' : `${named(change.actor)} put the cell`} under another profile.${came}`;
}

function cameOf(next: LogEvent | undefined): string {
  if (next === undefined || 'refused' in next.body) return '';
  if (next.kind === 'launch') return ' It was launched.';
  // Under that profile nobody would have been asked, and nothing begins by another profile.
  if (firstReason(next)['code'] === 'profile_changed') return ' It did not begin, and may be proposed again.';
  return ` It was ${outcomeWords(text(next.body['outcome']))}${because(next)}.`;
}

/** What the record says next of whether it began. */
function followingOf(events: readonly LogEvent[], { invocation }: Asked, last: LogEvent): LogEvent | undefined {
  return events.find((event) => event.seq > last.seq && event.invocation === invocation && (event.kind === 'launch' || event.kind === 'outcome'));
}

function approved(events: readonly LogEvent[], asked: Asked, last: LogEvent, named: Naming): Closing {
  const by = first(named(last.actor));
  if (question(last)['kind'] === 'session') return { words: `${by} let it go on.`, inVain: false, lapsed: false };
  const next = followingOf(events, asked, last);
  const what = edited(last) ? 'approved it, edited' : 'approved it';
  if (next === undefined) return { words: `${by} ${what}.`, inVain: false, lapsed: false };
  if (next.kind === 'outcome') return { words: `${by} ${what}, but it was ${outcomeWords(text(next.body['outcome']))}${because(next)}.`, inVain: true, lapsed: false };
  if (!('refused' in next.body)) return { words: `${by} ${what}: it was launched.`, inVain: false, lapsed: false };
  const { strong, text: why } = eventLine(next);
  return { words: `${by} ${what}, but in vain: ${strong.toLowerCase()}${why}.`, inVain: true, lapsed: false };
}

function edited(answer: LogEvent): boolean {
  const { edits } = question(answer);
  return Array.isArray(edits) && edits.length > 0;
}

/** The first of an outcome's reasons. */
function because(event: LogEvent): string {
  const said = plain(text(firstReason(event)['message'])).replaceAll('`', '').replace(/\.$/, '');
  return said === '' ? '' : `: ${said}`;
}
