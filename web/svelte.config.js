/**
 * By the short name of a component's styles, the styles themselves: two that got one name would mix.
 * @type {Map<string, string>}
 */
const named = new Map();

/**
 * Four characters instead of six and more, all over scripts and styles, keep a first load small.
 * @param {{ hash: (text: string) => string, css: string }} given
 */
function cssHash({ hash, css }) {
  const name = `s${hash(css).slice(0, 4)}`;
  if ((named.get(name) ?? css) !== css) throw new Error(`the styles of two components are both named ${name}: change a word in one`);
  named.set(name, css);
  return name;
}

/** Runes everywhere; no warning is let pass. */
export default { compilerOptions: { runes: true, discloseVersion: false, cssHash } };
