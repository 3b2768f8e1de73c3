const LEAST_PX = 48;
/** An observer speaks at shares of what it watches: these are near enough to tell pixels of a long card by. */
const SHARES = Array.from({ length: 41 }, (_, k) => k / 40);

/** Tells whenever something comes to be readable where it stands, or no longer is; returns how to end that. */
export function inSight(watched: Element, tell: (so: boolean) => void): () => void {
  const seen = new IntersectionObserver((entries) => tell((entries.at(-1)?.intersectionRect.height ?? 0) >= LEAST_PX), { threshold: SHARES });
  seen.observe(watched);
  return () => seen.disconnect();
}
