/** How long pictures of a cell may stay away before they are no longer the present; the server calls it silent after a second. */
export const QUIET_MS = 600;
/** A console to which they come seldom waits for twice its longest gap, but never longer than this. */
const LONGEST_MS = 2_000;
/** What counts of the time between two looks: a page that was busy has not looked, and what came lies before it unread. */
const LOOK_MS = 150;
const GAPS = 8;

/** Says from the coming of frames alone whether they have stopped; whoever asks brings the clock. */
export class Quiet {
  private waitedMs = 0;
  private lookedMs: number | null = null;
  private gaps: number[] = [];
  private any = false;

  /** A frame has come. */
  frame(): void {
    if (this.any) this.gaps = [...this.gaps, this.waitedMs].slice(-GAPS);
    this.any = true;
    this.waitedMs = 0;
  }

  /** Other frames are expected from now on: none has stopped that never came. */
  anew(): void {
    this.any = false;
    this.waitedMs = 0;
    this.gaps = [];
  }

  /** To be asked about ten times a second. */
  look(nowMs: number): boolean {
    this.waitedMs += Math.min(LOOK_MS, nowMs - (this.lookedMs ?? nowMs));
    this.lookedMs = nowMs;
    const patienceMs = Math.min(LONGEST_MS, Math.max(QUIET_MS, 2 * Math.max(0, ...this.gaps)));
    return this.any && this.waitedMs > patienceMs;
  }
}
