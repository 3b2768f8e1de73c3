/** What is looked for: the words between the blanks, whatever their case; the server parts and compares them so, too. */
export function wordsOf(text: string): string[] {
  return [...new Set(text.toLowerCase().split(/\s+/).filter((word) => word !== ''))];
}

/** One value of a document, under the names that lead to it. */
export interface Field {
  name: string;
  text: string;
}

/** All values of a document that can be read, in their order; what is empty has none. */
export function fieldsOf(document: unknown, name = ''): Field[] {
  if (Array.isArray(document)) return document.flatMap((item: unknown) => fieldsOf(item, name));
  if (typeof document === 'object' && document !== null) {
    return Object.entries(document).flatMap(([key, value]: [string, unknown]) => fieldsOf(value, name === '' ? key : `${name}.${key}`));
  }
  const readable = typeof document === 'string' || typeof document === 'number' || typeof document === 'boolean';
  return readable ? [{ name, text: String(document) }] : [];
}

/** Whether every word is contained in one of these texts. */
export function holdAll(texts: readonly string[], words: readonly string[]): boolean {
  const low = texts.map((text) => text.toLowerCase());
  return words.every((word) => low.some((text) => text.includes(word)));
}

/** Where a document holds words that what is shown of it does not: for each word one value, a long one around the word. */
export function heldIn(document: unknown, words: readonly string[], shown: string): Field[] {
  const missing = words.filter((word) => !holdAll([shown], [word]));
  if (missing.length === 0) return [];
  const fields = fieldsOf(document);
  const found = missing.flatMap((word) => fields.find(({ text }) => holdAll([text], [word])) ?? fields.find(({ name }) => holdAll([name], [word])) ?? []);
  return [...new Set(found)].map(({ name, text }) => ({ name, text: around(text, words) }));
}

const BEFORE = 30;
const LONG = 120;

function around(text: string, words: readonly string[]): string {
  if (text.length <= LONG) return text;
  const first = Math.min(...words.map((word) => text.toLowerCase().indexOf(word)).filter((at) => at >= 0), text.length);
  const from = first === text.length ? 0 : Math.max(0, first - BEFORE);
  const part = text.slice(from, from + LONG).replace(/^[\uDC00-\uDFFF]|[\uD800-\uDBFF]$/g, ''); // no half of a character
  return `${from > 0 ? '…' : ''}${part}${from + LONG < text.length ? '…' : ''}`;
}

/** A part of a text, and whether it is one of the words that were looked for. */
export interface Piece {
  text: string;
  hit: boolean;
}

/** A text in pieces, so that what was looked for can be marked in it. */
export function marked(text: string, words: readonly string[]): Piece[] {
  if (words.length === 0) return [{ text, hit: false }];
  const longestFirst = [...words].sort((a, b) => b.length - a.length).map((word) => word.replace(/[\\^$.*+?()[\]{}|/]/g, String.raw`\$&`));
  return text
    .split(new RegExp(`(${longestFirst.join('|')})`, 'giu'))
    .map((piece, k) => ({ text: piece, hit: k % 2 === 1 }))
    .filter((piece) => piece.text !== '');
}
