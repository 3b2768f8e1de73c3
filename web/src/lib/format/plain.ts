/**
 * Words that an agent chose, with a mark (U+FFFD) for each character that is not seen itself and changes what is: some turn
 * the rest of a line around (U+202E), so that it reads as something else than was asked (Unicode TR 36, 2.10).
 */
export function plain(said: string): string {
  return said.replace(/\p{Cf}/gu, '\uFFFD');
}

/** A document as it was recorded, where such characters stand as JSON escapes them: nothing is lost, and nothing turns around. */
export function recorded(document: unknown): string {
  const escaped = (unit: string): string => `\\u${unit.charCodeAt(0).toString(16).padStart(4, '0')}`;
  return JSON.stringify(document, null, 2).replace(/\p{Cf}/gu, (character) => character.split('').map(escaped).join(''));
}
