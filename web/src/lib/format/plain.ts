/**
 * Words that an agent chose, with a mark (U+FFFD) for each character that is not seen itself and changes what is: some turn
 * the rest of a line around (U+202E), so that it reads as something else than was asked (Unicode TR 36, 2.10).
 */
export function plain(said: string): string {
  return said.replace(/\p{Cf}/gu, '\uFFFD');
}

const MOST = 160;

/** As `plain`, of words at any length: their beginning, in one line, without marks that pile up over the lines around it. */
export function inBrief(said: string): string {
  const line = plain(said).replace(/[\s\p{Cc}]+/gu, ' ').replace(/(\p{M}{2})\p{M}+/gu, '$1').trim();
  const characters = Array.from(line); // and no half of one
  return characters.length <= MOST ? line : `${characters.slice(0, MOST - 1).join('')}…`;
}

/** A document as it was recorded, where such characters stand as JSON escapes them: nothing is lost, and nothing turns around. */
export function recorded(document: unknown): string {
  const escaped = (unit: string): string => `\\u${unit.charCodeAt(0).toString(16).padStart(4, '0')}`;
  return JSON.stringify(document, null, 2).replace(/\p{Cf}/gu, (character) => character.split('').map(escaped).join(''));
}
