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
  const bad = (problem: string, firstBad: number | null): Integrity => ({ is: 'bad', problem, firstBad, good: firstBad === null ? Math.min(found.size, signed.size) : found.size, atMs });
  if (!found.ok) return bad(found.problem ?? 'the server does not say what is wrong', found.first_bad);
  if (found.size < signed.size) return bad(`the signed checkpoint vouches for ${signed.size} events, ${found.size} are stored`, found.size + 1);
  if (found.size === signed.size && found.root !== signed.root) return bad('the recomputed root is not the signed one', null);
  if (seen !== null && found.size < seen.size) return bad(`this console has seen ${seen.size} events, ${found.size} are left`, found.size + 1);
  if (seen !== null && found.size === seen.size && found.root !== seen.root) return bad('the log has as many events as before, and another root', null);
  return { is: 'good', size: found.size, root: found.root, atMs };
}

/** The first characters of a root or digest: enough to compare by eye. */
export function shortRoot(root: string): string {
  return root.replace(/=+$/, '').slice(0, 12);
}
