/**
 * What is not seen itself: what turns or joins what is around it; letters and signs that are drawn as nothing; spaces beside
 * spaces, of which a browser draws each but the plain ones; and marks on a letter beyond those that any script needs, which
 * are drawn over the lines above and below.
 */
export const UNSEEN = new RegExp(
  String.raw`(?!${joiners()})\p{Cf}|[\u115F\u1160\u2800\u3164\uFFA0]|(?<=\p{Z})(?! )\p{Z}|(?<=\p{M}{4})\p{M}+`,
  'gu',
);

/** Joiners where they are drawn: between letters that would join or not, after a virama, within a picture (RFC 5892, A.1). */
function joiners(): string {
  const joining = String.raw`\p{Script=Arabic}\p{Script=Syriac}\p{Script=Mongolian}`;
  const viramas = String.raw`\u094D\u09CD\u0A4D\u0ACD\u0B4D\u0BCD\u0C4D\u0CCD\u0D4D\u0DCA`;
  const picture = String.raw`\p{Extended_Pictographic}`;
  const between = String.raw`(?<=[${joining}])[\u200C\u200D](?=[${joining}])|(?<=[${viramas}])[\u200C\u200D](?=\p{L})`;
  return String.raw`${between}|(?<=${picture}[\uFE0F\u{1F3FB}-\u{1F3FF}]?)\u200D(?=${picture})`;
}

/**
 * Words that an agent chose, with a mark (U+FFFD) for each character that is not seen itself and changes what is: some turn
 * the rest of a line around (U+202E), so that it reads as something else than was asked (Unicode TR 36, 2.10). Of marks that
 * pile up four are kept, with one U+FFFD for the others.
 */
export function plain(said: string): string {
  return said.replace(UNSEEN, '\uFFFD');
}

const MOST = 160;

/** As `plain`, of words at any length: their beginning, in one line, with fewer marks on a letter. */
export function inBrief(said: string): string {
  const line = plain(said.replace(/[\p{Z}\p{Cc}]+/gu, ' ').replace(/(\p{M}{2})\p{M}+/gu, '$1')).trim();
  const characters = Array.from(line); // and no half of one
  return characters.length <= MOST ? line : `${characters.slice(0, MOST - 1).join('')}…`;
}
