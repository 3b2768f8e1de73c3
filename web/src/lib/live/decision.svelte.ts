import { ApiError, type Answer, type Api, type Offer } from '../api/client';
import type { Escalation, InputSchema, Params } from '../api/documents';
import { entryOf } from '../format/entry';
import { quoted } from '../format/quoted';
import { ARM_MS } from '../keys/arming.svelte';
import { checkEdit, mayApprove, readEdit, rowsOf, type Check, type Typed } from './edit';

const SETTLE_MS = 250;

const WORDS: Record<string, string> = {
  digest_mismatch: 'The question has changed since you read it. Look again.',
  already_resolved: 'Somebody has answered this already.',
  already_approved: 'You approved this already: it takes another person.',
  escalation_expired: 'The time to answer is over.',
  own_proposal: 'Nobody answers for what they proposed themselves.',
  grant_refused: 'This cannot be allowed in advance:',
  edit_refused: 'Policy refuses the edited values.',
};

/** Why a press of approve was not taken. */
const WITHHELD: Partial<Record<Check['is'], string>> = {
  checking: 'your edit was still being checked. Press again once it is allowed.',
  faulty: 'correct your edit first.',
  refused: 'policy refuses your edit.',
  'given back': 'policy had just given other values back. Read them, then press again.',
};

/** What is said of an edit that goes because another question stands in the place of the one it was of. */
const UNSENT = 'Your edit was of what was asked before: it was not sent, and is gone.';
const IN_VAIN = 'Your edit was of what was asked before: it does not count, and is gone.';

/** How the choice reads that allows nothing in advance. */
export const ASK_AGAIN = 'ask me again next time';

/** What was typed on a card that is gone, of which question, and what became of sending it. */
export interface Draft {
  asked: Escalation;
  typed: Typed;
  sent: boolean;
  refused: boolean;
}

type Asks = Pick<Api, 'check' | 'events' | 'resolve'>;

/** One person's answer in the making: what was typed, what policy says to it, and what became of sending it. */
export class Decision {
  typed = $state.raw<Typed>({});
  check = $state.raw<Check>({ is: 'untouched' });
  sending = $state<'approve' | 'deny' | null>(null);
  problem = $state('');
  /** Why the last press approved nothing, although it was meant to. */
  withheld = $state('');
  /** What became of an edit of what is not asked any more; empty where none was lost. */
  lost = $state('');
  /** Somebody else's answer came first: the record says which. */
  late = $state(false);
  code = $state('');
  /** More of the same, to be allowed in advance together with this. */
  offer = $state.raw<Offer | null>(null);
  asked: Escalation;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private turn = 0;
  /** What was typed as it was last sent. */
  private sent = $state.raw<Typed | null>(null);
  /** Whether the server would not have what was sent last: without its word that is not known. */
  private refused = false;
  /** Counts the answers: what an older one meets says nothing any more. */
  private sends = 0;
  /** The question has its answer: its card goes with the next update, and takes no other one until then. */
  private over = $state(false);

  constructor(
    private readonly api: Asks,
    asked: Escalation,
    private readonly context: () => { schema: Record<string, InputSchema>; cell: string | null },
  ) {
    this.asked = $state.raw(asked);
  }

  readonly schema = $derived.by(() => this.context().schema);
  readonly rows = $derived.by(() => rowsOf(this.asked, Object.keys(this.schema)));
  readonly edit = $derived.by(() => readEdit(this.typed, this.asked.effective, this.schema));
  readonly edited = $derived.by(() => Object.keys(this.edit.params).length > 0);
  /** What approving does, a grant that goes with it included. */
  readonly approves = $derived.by(() => {
    const allowing = this.offer === null ? '' : ` and allow for ${this.offer.minutes} min`;
    return `${this.edited ? 'Approve edit' : 'Approve'}${allowing}`;
  });
  readonly ready = $derived.by(() => this.sending === null && mayApprove(this.check));
  /** A denial waits for no approval that is on its way. */
  readonly deniable = $derived.by(() => this.sending !== 'deny' && !this.over);
  /** What a press of approve is about: what is asked, what was typed, and what policy said to it. */
  readonly shown = $derived.by(() => JSON.stringify([this.asked.digest, this.typed, this.check, this.offer, this.ready]));

  /** Whether something was typed that was never sent, and goes with the page. */
  readonly unsent = $derived.by(() => (this.edited || Object.keys(this.edit.faults).length > 0) && !this.over && this.typed !== this.sent);

  /** Gives away what was typed and is not answered, as its card goes: policy is not asked about it any more. Null where nothing was typed, or it is what is asked anyway. */
  putDown(): Draft | null {
    clearTimeout(this.timer);
    const kept = this.edited || Object.keys(this.edit.faults).length > 0;
    return kept && !this.over ? { asked: this.asked, typed: this.typed, sent: this.typed === this.sent, refused: this.refused } : null;
  }

  /** Goes on with what was typed on a card before this one; of what is not asked any more it says that it is gone. */
  takeUp({ asked, typed, sent, refused }: Draft): void {
    const now = this.asked;
    this.asked = asked;
    const { problem } = this;
    for (const [name, text] of Object.entries(typed)) this.type(name, text);
    [this.problem, this.sent, this.refused] = [problem, sent ? this.typed : null, refused];
    this.update(now);
  }

  /** Takes a newer version of the question. Another digest is another question: what was typed, or to be allowed in advance, no longer stands. */
  update(newer: Escalation): void {
    if (newer.digest !== this.asked.digest) {
      const lost = this.losing(newer);
      this.discard();
      this.offer = null;
      this.lost ||= lost;
    }
    this.asked = newer;
  }

  /** What to say of an edit that another question leaves behind; nothing where that has it, or may have been made by it. */
  private losing({ effective }: Escalation): string {
    const faulty = Object.keys(this.edit.faults).length > 0;
    if (!faulty && Object.entries(this.edit.params).every(([name, value]) => entryOf(effective, name) === value)) return '';
    if (this.typed !== this.sent) return UNSENT;
    return this.refused ? IN_VAIN : '';
  }

  type(name: string, text: string): void {
    this.typed = { ...this.typed, [name]: text };
    this.problem = this.withheld = this.lost = '';
    this.turn += 1;
    clearTimeout(this.timer);
    if (Object.keys(this.edit.faults).length > 0) this.check = { is: 'faulty' };
    else if (!this.edited) this.check = { is: 'untouched' };
    else {
      this.check = { is: 'checking' };
      this.timer = setTimeout(() => void this.ask(), SETTLE_MS);
    }
  }

  /** Asks policy anew about what was typed: what it said was said of the cell as it was. */
  again(): void {
    if (!this.edited || Object.keys(this.edit.faults).length > 0) return;
    clearTimeout(this.timer);
    this.check = { is: 'checking' };
    void this.ask();
  }

  discard(): void {
    clearTimeout(this.timer);
    this.turn += 1;
    this.withheld = this.lost = '';
    this.typed = {};
    this.check = { is: 'untouched' };
  }

  async approve(): Promise<Escalation | null> {
    if (!this.ready) {
      this.withhold();
      return null;
    }
    const answer: Answer = { decision: 'approve', digest: this.asked.digest };
    if (this.edited) answer.params = this.edit.params;
    if (this.offer !== null) answer.grant = this.offer;
    const typed = (this.sent = this.typed);
    const answered = await this.send(answer);
    const same = answered?.status === 'pending' && answered.digest === answer.digest && this.typed === typed; // what was typed meanwhile stands
    if (answer.params !== undefined && same) this.giveBack(answer.params, answered.effective);
    return answered;
  }

  /** Says why a press counted for nothing: it is never kept for what is shown later. */
  withhold(): void {
    if (this.sending !== null) return;
    const why = this.ready ? 'what was shown changed while you pressed. Read it, then press again.' : WITHHELD[this.check.is];
    this.withheld = why === undefined ? '' : `Nothing was approved: ${why}`;
  }

  deny(): Promise<Escalation | null> {
    if (!this.deniable) return Promise.resolve(null);
    const answer: Answer = { decision: 'deny', digest: this.asked.digest };
    if (this.code !== '') answer.code = this.code;
    return this.send(answer);
  }

  private async ask(): Promise<void> {
    const turn = (this.turn += 1);
    const check = await checkEdit(this.api, this.asked, this.edit.params, this.context().cell);
    if (turn === this.turn) this.check = check;
  }

  /** An edit that policy cut to what was asked before is the same question: no other digest says so, and what was typed is done with. */
  private giveBack(edit: Params, effective: Params): void {
    this.discard();
    const to = Object.fromEntries(Object.keys(edit).map((name) => [name, effective[name] ?? null]));
    this.check = { is: 'given back', to, read: false };
    this.timer = setTimeout(() => (this.check = { is: 'given back', to, read: true }), ARM_MS);
  }

  private async send(answer: Answer): Promise<Escalation | null> {
    const turn = (this.sends += 1);
    this.sending = answer.decision;
    this.problem = this.withheld = this.lost = '';
    this.refused = false;
    try {
      const answered = await this.api.resolve(this.asked.id, answer);
      if (answered.status !== 'pending') this.over = true;
      return answered;
    } catch (error) {
      if (turn === this.sends) this.refuse(error, answer);
      return null;
    } finally {
      if (turn === this.sends && !this.over) this.sending = null;
    }
  }

  private refuse(error: unknown, answer: Answer): void {
    this.late = error instanceof ApiError && error.code === 'already_resolved';
    this.problem = error instanceof ApiError ? refusal(error, answer) : String(error instanceof Error ? error.message : error);
    this.refused = error instanceof ApiError && error.code !== 'unreachable';
    // What is asked may have become another question before it was said that the edit does not count.
    if (this.refused && answer.params !== undefined && answer.digest !== this.asked.digest) this.lost ||= IN_VAIN;
  }
}

/** Why an answer was not taken, in words; of what was to be allowed in advance also what was wrong with it, and the way out. */
function refusal(error: ApiError, answer: Answer): string {
  const { reasons = [], errors = [], status } = error.problem;
  const otherwise = `Choose “${ASK_AGAIN}” to approve only this.`;
  if (answer.grant === undefined || status !== 422) {
    const said = [entryOf(WORDS, error.code) ?? error.message, ...reasons.map((reason) => quoted(reason.message))].join(' ');
    return error.code === 'grant_refused' ? `${said}. ${otherwise}` : said;
  }
  const fields = errors.map(({ field }) => `“${field}”`).join(', ');
  return `What is to be allowed in advance does not fit${fields === '' ? '' : ` (${fields})`}: ${error.message} ${otherwise}`;
}
