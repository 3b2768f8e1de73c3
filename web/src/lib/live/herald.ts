import type { Escalation } from '../api/documents';
import { titleOf } from '../format/capability';

/** What comes within this time of the last words is told in one sentence: five questions at once are no five alarms. */
export const TOGETHER_MS = 4_000;

/**
 * Decides what is said aloud of new questions, and when.
 *
 * A question is announced when it comes, not again when the page or the link comes back to it. The first one is told at
 * once and in full; those that follow on its heels are counted, with the most urgent one named.
 */
export class Herald {
  private known: ReadonlySet<string> | null = null;
  private untold: ReadonlySet<string> = new Set();
  private waiting: readonly Escalation[] = [];
  private spokeMs = -Infinity;
  private said = '';

  /** Takes what waits now, the most urgent first. What waited before anybody listened is on screen, and not said. */
  take(waiting: readonly Escalation[]): void {
    const ids = waiting.map((item) => item.id);
    const fresh = this.known === null ? [] : ids.filter((id) => this.known?.has(id) === false);
    this.untold = new Set([...this.untold].filter((id) => ids.includes(id)).concat(fresh));
    this.known = new Set(ids);
    this.waiting = waiting;
  }

  /** How long, ms, until there is something to say; null while there is nothing. */
  dueInMs(nowMs: number): number | null {
    return this.untold.size === 0 ? null : Math.max(0, this.spokeMs + TOGETHER_MS - nowMs);
  }

  /** Returns what is to be said now, once, and that it waits for `whom`; `held` says what the gripper of its cell holds; null while nothing is due. */
  speak(nowMs: number, where: (item: Escalation) => string = () => '', whom = 'you', held: (item: Escalation) => string | null = () => null): string | null {
    if (this.dueInMs(nowMs) !== 0) return null;
    const fresh = this.waiting.filter((item) => this.untold.has(item.id));
    this.untold = new Set();
    const first = fresh[0];
    if (first === undefined) return null;
    this.spokeMs = nowMs;
    const named = `${titleOf(first.capability, first.effective, held(first))}${where(first)}, ${first.risk} risk.`;
    const words = fresh.length === 1 ? `Waiting for ${whom}: ${named}` : `${fresh.length} new questions, ${this.waiting.length} wait for ${whom}. Most urgent of the new: ${named}`;
    // A text that does not change is not heard: the one before may have gone, and this have come, in one drawing.
    this.said = words === this.said ? `${words}\u00A0` : words;
    return this.said;
  }
}
