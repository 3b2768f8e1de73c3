import { plain } from './plain';
import { withShortIds } from './status';

/** The server's words for a person: names stand in quotes, not in backticks, ids are short, and what is valid is a sentence. */
export function quoted(said: string): string {
  return withShortIds(plain(said).replace(/`([^`]*)`/g, '“$1”')).replace(/; valid: /g, '. What works: ');
}

/** As `quoted`, with a capital, and a full stop where there is none. */
export function sentence(said: string): string {
  const words = quoted(said);
  const begun = words.charAt(0).toUpperCase() + words.slice(1);
  return /[.!?]$/.test(begun) ? begun : `${begun}.`;
}
