import type { Cell } from '../api/documents';

/** A violation is shown for so long after it was last so: at the very edge of a limit it comes and goes. */
export const LASTING_MS = 1_500;

/**
 * What is wrong, by name, as it is shown: at once when it begins, and a while longer than it lasts, so that nobody reads
 * "clear" between two violations. It never tells of one that there was not.
 */
export class Lasting<T> {
  private seen: Readonly<Record<string, { what: T; atMs: number }>> = {};
  private now: Readonly<Record<string, T>> = {};

  /** Takes what is wrong now; returns what is shown as wrong. What was so until now counts from now. */
  take(now: Readonly<Record<string, T>>, nowMs: number): Record<string, T> {
    const lasts = Object.entries(this.seen).filter(([, { atMs }]) => nowMs - atMs < LASTING_MS);
    const fresh = Object.entries({ ...this.now, ...now }).map(([name, what]) => [name, { what, atMs: nowMs }] as const);
    this.seen = Object.fromEntries([...lasts, ...fresh]);
    this.now = now;
    return Object.fromEntries(Object.entries(this.seen).map(([name, { what }]) => [name, what]));
  }

  /** How long, ms, until something is to be shown no more; null while nothing lasts longer than it is so. */
  dueInMs(nowMs: number): number | null {
    const over = Object.entries(this.seen).filter(([name]) => !Object.hasOwn(this.now, name));
    return over.length === 0 ? null : Math.max(0, Math.min(...over.map(([, { atMs }]) => atMs)) + LASTING_MS - nowMs);
  }
}

/** The cells with what their sessions have violated until a moment ago; those of which nothing lasts are the same. */
export function withLasting(cells: Readonly<Record<string, Cell>>, violations: Lasting<string>, nowMs: number): Record<string, Cell> {
  const about = (cell: Cell): string => JSON.stringify([cell.id, cell.busy]);
  const now = Object.values(cells).flatMap((cell) => (cell.session?.violated ?? []).map((rule) => [`${about(cell)} ${rule}`, rule] as const));
  const shown = Object.entries(violations.take(Object.fromEntries(now), nowMs));
  const over = (cell: Cell): Cell => {
    const { session } = cell;
    const rules = shown.filter(([name]) => name.startsWith(`${about(cell)} `)).map(([, rule]) => rule);
    if (session == null || rules.length === session.violated.length) return cell;
    return { ...cell, session: { ...session, violated: rules } };
  };
  return Object.fromEntries(Object.entries(cells).map(([id, cell]) => [id, over(cell)]));
}
