import subsetFont from 'subset-font';
import type { Plugin } from 'vite';

/** What a page that is read needs of a font: spacing, figures of one width, marks over letters. "->" stays what somebody wrote, and no arrow. */
const FEATURES: readonly string[] = ['kern', 'tnum', 'ccmp', 'locl', 'mark', 'mkmk'];
/** What the weights in tokens.css lie between. */
const WEIGHTS = { min: 400, max: 700 };
const RANGE = /unicode-range:\s*([^;}]+)/g;

/** Leaves in each font what the console shows with it: the characters of the `unicode-range` it is declared for, in the weights in use. */
export function leanFonts(): Plugin {
  return {
    name: 'reins-lean-fonts',
    apply: 'build',
    enforce: 'post', // the style sheet is among the assets by then
    async generateBundle(_, bundle) {
      const assets = Object.values(bundle).filter((one) => one.type === 'asset');
      const styles = assets.filter(({ fileName }) => fileName.endsWith('.css')).map(({ source }) => Buffer.from(source).toString());
      const text = styles.flatMap((style) => [...style.matchAll(RANGE)].map((found) => charactersOf(found[1] ?? ''))).join('');
      if (text === '') throw new Error('no style sheet says by a `unicode-range` what the fonts are for');
      for (const asset of assets.filter(({ fileName }) => fileName.endsWith('.woff2'))) {
        asset.source = await subsetFont(Buffer.from(asset.source), text, { targetFormat: 'woff2', keepFeatures: FEATURES, variationAxes: { wght: WEIGHTS } });
      }
    },
  };
}

/** `U+0-FF, U+131, U+20??` as a string of all of them. Throws on a part that names none. */
function charactersOf(range: string): string {
  return range.split(',').map((part) => {
    const [first = '', last = first] = part.trim().replace(/^U\+/i, '').split('-');
    const from = Number.parseInt(first.replaceAll('?', '0'), 16);
    const to = Number.parseInt(last.replaceAll('?', 'F'), 16);
    if (!(from <= to)) throw new Error(`\`${part.trim()}\` in a \`unicode-range\` names no characters; valid is for instance \`U+0000-00FF\``);
    return Array.from({ length: to - from + 1 }, (_, at) => String.fromCodePoint(from + at)).join('');
  }).join('');
}
