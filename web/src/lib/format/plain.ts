/**
 * Words that an agent chose, with a mark (U+FFFD) for each character that is not seen itself and changes what is: some turn
 * the rest of a line around (U+202E), so that it reads as something else than was asked (Unicode TR 36, 2.10).
 */
export function plain(said: string): string {
  return said.replace(/\p{Cf}/gu, '\uFFFD');
}
