import type { Asked } from './closed';

/** So many are kept until they are put away. */
const KEPT = 20;

/** An answer of this person's that did not count, as far as that is known. */
export interface Unheard extends Asked {
  title: string;
  problem: string;
  /** Whether the record says what somebody else made of the question. */
  unread: boolean;
}

/** The answers from here that did not count, until whoever gave them knows: they outlive the card, and the page, that they were given on. */
export class Unheeded {
  news: readonly Unheard[] = $state.raw([]);

  /** What the last answer to a question met; empty where there was none, or it counted. */
  of(id: string): string {
    return this.news.find((one) => one.id === id)?.problem ?? '';
  }

  /** Takes what became of an answer, of which an empty problem says that it counts; of answers to other questions that says nothing. */
  take(asked: Asked & { title: string }, problem: string, unread: boolean): void {
    this.putAway(asked.id);
    if (problem !== '') this.news = [{ ...asked, problem, unread }, ...this.news].slice(0, KEPT);
  }

  putAway(id: string): void {
    this.news = this.news.filter((one) => one.id !== id);
  }
}
