import { fullTime } from '../format/time';
import type { Looked } from './search';
import type { Sought } from './finding.svelte';

const COUNT = new Intl.NumberFormat('en-GB');

/** What was found, and how far it was looked for. */
export interface Told {
  what: Sought;
  count: number;
  /** Whether there is more behind it. */
  more: boolean;
  looked: Looked;
  /** Whether words were searched for, so that what is not listed was looked at all the same. */
  searched: boolean;
  filtered: boolean;
  newestFirst: boolean;
}

/** How many were found, in words; where words were searched for, also how far that has come. */
export function foundWords(told: Told): string {
  if (told.count === 0 && told.looked.count === 0) return told.filtered || told.searched ? 'Nothing found.' : `No ${told.what} are recorded yet.`;
  const found = foundSo(told);
  return told.searched ? `${found}${told.more ? ' so far' : ''}. ${howFar(told)}` : found;
}

function foundSo({ what, count, more, searched }: Told): string {
  if (count === 0) return 'Nothing found';
  return more && !searched ? `${COUNT.format(count)} or more ${what}` : counted(count, what);
}

function howFar({ what, more, looked: { count, at }, newestFirst }: Told): string {
  const those = counted(count, what);
  if (!more) return count === 1 ? 'The only one was searched.' : `All ${those} were searched.`;
  const bound = at === null ? '' : `, ${newestFirst ? 'back' : 'up'} to ${fullTime(at)}`;
  return `The ${newestFirst ? 'newest' : 'oldest'} ${those} were searched${bound}.`;
}

function counted(count: number, what: Sought): string {
  return `${COUNT.format(count)} ${count === 1 ? what.slice(0, -1) : what}`;
}
