/** Runes everywhere; no warning is let pass. */
export default { compilerOptions: { runes: true } };
