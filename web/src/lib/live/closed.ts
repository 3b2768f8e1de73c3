import type { Escalation, Invocation, Json, LogEvent } from '../api/documents';
import { eventLine } from '../format/events';
import { plain } from '../format/plain';
import { outcomeWords } from '../format/status';

export type Asked = Pick<Escalation, 'id' | 'invocation'>;

/** How a question ended that is not open any more. */
export interface Closing {
  /** As a sentence; null where nothing is known of it. */
  words: string | null;
  /** Approved, and refused or deferred all the same. */
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

/** Who reads of what they did themselves is not told their own name. */
type Naming = (actor: string) => string;

/** Says how a question ended, as the record has it; `invocation` is what it was about, as far as that is known, `me` whoever reads. */
export function closingOf(events: readonly LogEvent[], asked: Asked, invocation: Invocation | null, me: string | null = null): Closing {
  const named: Naming = (actor) => (actor === me ? 'you' : actor);
  const told = events.filter((event) => question(event)['id'] === asked.id);
  const last = told.findLast((event) => question(event)['status'] !== 'pending');
  const over = invocation?.outcome == null ? null : 'It is over.';
  // What its cell withdraws is not recorded as an answer: whose word it was is.
  if (last === undefined) return { words: instead(events, asked, Infinity, named) ?? over, inVain: false, lapsed: false };
  if (question(last)['status'] === 'approved') return approved(events, asked, last, named);
  return { words: unapproved(events, asked, last, named) ?? over ?? 'It was withdrawn.', inVain: false, lapsed: question(last)['status'] === 'expired' };
}

function first(name: string): string {
  return name === 'you' ? 'You' : name;
}

function unapproved(events: readonly LogEvent[], asked: Asked, last: LogEvent, named: Naming): string | null {
  if (question(last)['status'] === 'denied') return `${first(named(last.actor))} denied.`;
  if (question(last)['status'] === 'expired') return 'Nobody answered in time.';
  return instead(events, asked, last.seq, named);
}

function instead(events: readonly LogEvent[], { invocation }: Asked, before: number, named: Naming): string | null {
  // What a cell asks is recorded as its own report, which names no question.
  const since = events.findLast((event) => event.kind === 'escalation' && event.invocation === invocation && event.seq < before)?.seq ?? 0;
  const word = events.findLast((event) => event.kind === 'human' && event.invocation === invocation && event.seq > since && 'role' in event.body && Object.hasOwn(INSTEAD, text(event.body['op'])));
  return word === undefined ? null : `It was withdrawn: ${named(word.actor)} ${INSTEAD[text(word.body['op'])]}.`;
}

function approved(events: readonly LogEvent[], { invocation }: Asked, last: LogEvent, named: Naming): Closing {
  const by = first(named(last.actor));
  if (question(last)['kind'] === 'session') return { words: `${by} let it go on.`, inVain: false, lapsed: false };
  const next = events.find((event) => event.seq > last.seq && event.invocation === invocation && (event.kind === 'launch' || event.kind === 'outcome'));
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
  const reasons = event.body['reasons'];
  const said = plain(text(record(Array.isArray(reasons) ? reasons[0] : undefined)['message'])).replaceAll('`', '').replace(/\.$/, '');
  return said === '' ? '' : `: ${said}`;
}
