import type { Review, ReviewVerdict, Risk } from '../api/documents';
import { entryOf } from '../format/entry';
import { plain } from '../format/plain';
import { outcomeWords } from '../format/status';

const RISKS: Record<Risk, number> = { critical: 3, high: 2, medium: 1, low: 0 };

export const VERDICTS: readonly { verdict: ReviewVerdict; says: string; means: string }[] = [
  { verdict: 'accepted', says: 'Accepted', means: 'it went as it should' },
  { verdict: 'objected', says: 'Objected', means: 'it should not go so again' },
  { verdict: 'inconclusive', says: 'Inconclusive', means: 'the record does not tell' },
];

/** What waits for a verdict: the higher risk first, then what has waited longest. The server chooses in the same order what to tell of. */
export function waitingOf(reviews: Readonly<Record<string, Review>>): Review[] {
  return Object.values(reviews)
    .filter((review) => review.status === 'waiting')
    .sort((a, b) => gravity(b) - gravity(a) || inOrder(a.created_at, b.created_at) || inOrder(a.id, b.id));
}

/** What has a verdict, the newest verdict first. */
export function judgedOf(reviews: readonly Review[]): Review[] {
  return reviews.filter((review) => review.verdict !== null).sort((a, b) => inOrder(b.verdict?.at ?? '', a.verdict?.at ?? ''));
}

/** How much of what waits is shown, where that is not all. */
export function shownWords(shown: number, all: number): string {
  return shown < all ? `${shown} of ${all} shown; the rest follow as these are judged.` : '';
}

/** How many letters the server takes of a note. */
const NOTE_LENGTH = 4096;

/** What to say of a note that cannot be recorded whole; empty where it can. Nothing of it is cut off unsaid. */
export function tooLong(note: string): string {
  const over = Array.from(note.trim()).length - NOTE_LENGTH; // as the server counts them, a picture as one
  return over > 0 ? `The note is ${over} ${over === 1 ? 'letter' : 'letters'} longer than the record takes.` : '';
}

function gravity({ risk }: Review): number {
  return entryOf(RISKS, risk) ?? -1;
}

function inOrder(a: string, b: string): number {
  return a < b ? -1 : a > b ? 1 : 0;
}

/** Why a review is due, as one sentence. */
export function dueWords(review: Review): string {
  const said = review.reasons.map(({ message }) => plain(message).replace(/`([a-z_]+)`/g, (_, outcome: string) => `“${outcomeWords(outcome)}”`).replaceAll('`', ''));
  return said.map((words) => words.replace(/^./, (c) => c.toUpperCase())).join('; ');
}
