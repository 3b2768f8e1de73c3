import { ApiError, type Api } from '../api/client';
import type { Review, ReviewVerdict } from '../api/documents';
import { entryOf } from '../format/entry';

const WORDS: Record<string, string> = {
  already_reviewed: 'Somebody has given a verdict already; yours is not recorded.',
  own_proposal: 'Nobody reviews what they proposed themselves.',
  unreachable: 'No answer from the server: it is not known whether your verdict was recorded.',
};
const AGAIN_MS = 2_000;
/** So many notes that came too late are kept until they are put away. */
const LEFT_KEPT = 20;

/** One person's verdict in the making: it outlives the row, and the page, that it is written on. */
export class Draft {
  verdict = $state<ReviewVerdict | ''>('');
  note = $state('');
  sending = $state(false);
  problem = $state('');
  /** How many forms show it. */
  forms = 0;

  constructor(readonly review: Review) {}

  get begun(): boolean {
    return this.sending || this.verdict !== '' || this.note.trim() !== '';
  }
}

/** A note that was typed for a review, which has the verdict of somebody else. */
export interface Left {
  review: Review;
  /** What its session was about, as it was known then. */
  title: string;
  note: string;
}

/** The verdicts that are being written at this console, and what became of them; kept as long as the tab lives and the review waits. */
export class Reviewing {
  /** The review that is open on Live. */
  open = $state<string | null>(null);
  told = $state('');
  left = $state.raw<readonly Left[]>([]);
  private drafts: Readonly<Record<string, Draft>> = {};
  private known: Readonly<Record<string, Review>> = {};
  /** Counts the rounds of asking: what an older one brings means nothing any more. */
  private turn = 0;
  private again: ReturnType<typeof setTimeout> | undefined;

  constructor(
    private readonly api: Pick<Api, 'review' | 'reviewsOf'>,
    private readonly me: () => string | null,
    private readonly title: (review: Review) => string,
  ) {}

  /** The open review, as long as it waits: graver ones may have taken its place among those that are told of. */
  get opened(): Review | null {
    return this.open === null ? null : (entryOf(this.drafts, this.open)?.review ?? null);
  }

  /** The sessions of which a note was written and not sent: it goes with the page. */
  get unsent(): readonly string[] {
    return Object.values(this.drafts).filter(({ note, sending }) => note.trim() !== '' && !sending).map(({ review }) => this.title(review));
  }

  /** What is being written on a review. */
  of(review: Review): Draft {
    const known = entryOf(this.drafts, review.id);
    if (known !== undefined) return known;
    const draft = new Draft(review);
    this.drafts = { ...this.drafts, [review.id]: draft };
    return draft;
  }

  /** Keeps what a form shows, and what was written there beyond it; returns how to say that the form has gone. */
  keep(draft: Draft): () => void {
    draft.forms += 1;
    return () => {
      draft.forms -= 1;
      if (draft.forms === 0 && !draft.begun) this.drop(draft.review.id);
    };
  }

  toggle(review: Review): void {
    this.told = '';
    if (this.open !== review.id) this.of(review);
    this.open = this.open === review.id ? null : review.id;
  }

  putAway(id: string): void {
    this.left = this.left.filter(({ review }) => review.id !== id);
  }

  /** Records a verdict; returns whether it is. */
  async send(draft: Draft): Promise<boolean> {
    const { verdict, review } = draft;
    if (draft.sending || verdict === '') return false;
    const title = this.title(review); // what waits no more may be forgotten before the answer comes
    draft.sending = true;
    draft.problem = '';
    try {
      this.settle(await this.api.review(review.id, verdict, draft.note.trim()), true, title);
      return true;
    } catch (error) {
      draft.problem = said(error);
      draft.sending = false; // what is recorded takes no second verdict
      if (draft.forms === 0) this.told = `${title}: ${draft.problem}`;
      this.resume(this.known); // what came meanwhile was left to the answer
      return false;
    }
  }

  /** Takes what is known of reviews as it changes. */
  follow(known: Readonly<Record<string, Review>>): void {
    this.known = known;
    for (const { review, sending } of Object.values(this.drafts)) {
      const newest = entryOf(known, review.id);
      if (newest !== undefined && newest.verdict !== null && !sending) this.settle(newest, false, this.title(newest));
    }
  }

  /** Takes what a new link says. It tells of what waits alone: what became of the rest, the server is asked. */
  resume(known: Readonly<Record<string, Review>>): void {
    this.follow(known);
    void this.ask();
  }

  end(): void {
    this.turn += 1;
    clearTimeout(this.again);
  }

  private async ask(): Promise<void> {
    clearTimeout(this.again);
    const turn = (this.turn += 1);
    try {
      for (const { review } of Object.values(this.drafts)) {
        if (Object.hasOwn(this.known, review.id)) continue;
        const found = await this.api.reviewsOf(review.invocation);
        if (turn !== this.turn) return;
        this.follow({ ...this.known, ...Object.fromEntries(found.items.map((one) => [one.id, one])) });
      }
    } catch {
      if (turn === this.turn) this.again = setTimeout(() => void this.ask(), AGAIN_MS);
    }
  }

  /** A review has its verdict, whoever gave it: nothing that was written for it goes without a word. */
  private settle(closed: Review, mine: boolean, title: string): void {
    const draft = entryOf(this.drafts, closed.id);
    if (draft === undefined || closed.verdict === null) return;
    this.drop(closed.id);
    const { by, verdict, note } = closed.verdict;
    const typed = draft.note.trim();
    if (!mine && typed !== '' && typed !== note) this.left = [{ review: closed, title, note: typed }, ...this.left].slice(0, LEFT_KEPT);
    const words = mine ? `Recorded: ${verdict}.` : `${by === this.me() ? 'You' : by} reviewed it: ${verdict}.`;
    if (this.open === closed.id) {
      this.open = null;
      this.told = words;
    } else if (mine) this.told = `${title}: ${words}`; // it was closed, or another one opened, while this was sent
  }

  private drop(id: string): void {
    this.drafts = Object.fromEntries(Object.entries(this.drafts).filter(([known]) => known !== id));
  }
}

function said(error: unknown): string {
  if (error instanceof ApiError) return entryOf(WORDS, error.code) ?? error.message;
  return error instanceof Error ? error.message : String(error);
}
