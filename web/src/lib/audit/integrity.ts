import type { Checkpoint, Verification } from '../api/documents';

/** What is known of the log's integrity, and when it was checked. */
export type Integrity =
  | { is: 'unchecked' }
  | { is: 'checking' }
  | { is: 'good'; size: number; root: string; atMs: number }
  | { is: 'bad'; problem: string; firstBad: number | null; good: number; atMs: number }
  | { is: 'unknown'; why: string; atMs: number };

/**
 * Judges a verification against the signed checkpoint that was fetched before it.
 *
 * The log only grows: what is verified may reach beyond that checkpoint and may not fall short of it, nor of the largest
 * log this console has seen.
 */
export function judge(signed: Checkpoint, found: Verification, seen: { size: number; root: string } | null, atMs: number): Integrity {
  const { size, root } = found;
  if (!found.ok) return { is: 'bad', problem: found.problem ?? UNSAID, firstBad: found.first_bad, good: size, atMs };
  const signedSays = `the signed checkpoint vouches for ${signed.size} events, ${size} are stored`;
  const wrong =
    falls(found, signed, signedSays, 'the recomputed root is not the signed one') ??
    (seen === null ? null : falls(found, seen, `this console has seen ${seen.size} events, ${size} are left`, 'the log has as many events as before, and another root'));
  return wrong === null ? { is: 'good', size, root, atMs } : { is: 'bad', ...wrong, atMs };
}

/** How many events the log has, as `seq` counts them, beyond those that were found to hold. */
export function newerThan(found: Integrity, seq: number): number {
  return found.is === 'good' ? Math.max(0, seq - found.size) : 0;
}

const UNSAID = 'the server does not say what is wrong';

/** How what was found falls short of what is known. Where roots differ, the tree does not say which event does: none is good. */
function falls(
  found: Verification,
  known: { size: number; root: string },
  missing: string,
  other: string,
): { problem: string; firstBad: number | null; good: number } | null {
  if (found.size < known.size) return { problem: missing, firstBad: found.size + 1, good: found.size };
  if (found.size === known.size && found.root !== known.root) return { problem: other, firstBad: null, good: 0 };
  return null;
}

/** The first characters of a root or digest: enough to compare by eye. */
export function shortRoot(root: string): string {
  return root.replace(/=+$/, '').slice(0, 12);
}
