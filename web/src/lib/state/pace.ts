/** The least time between two drawings, ms: what the server sends at most as often. */
export const LEAST_MS = 33;
/** Of its time a page gives at most one part in so many to drawing what comes; the rest is for whoever presses a key. */
export const SHARE = 4;
/** But it draws again by then, however long that takes: what is shown counts as the present. */
export const MOST_MS = 400;

/**
 * Draws what comes at the pace the page can keep: at once after a quiet moment, then the less often the longer a drawing
 * takes. A flood of proposals must not keep an operator from being heard. Of two drawings the quicker one counts: once, it was
 * something else that the page was busy with, and what is drawn late for that is an old state that looks like the present.
 */
export class Pace {
  private wanted = false;
  private running = false;
  /** What the drawing before took, ms. */
  private before = Infinity;
  /** What one is taken to cost, ms. */
  private cost = 0;
  /** When the oldest of what waits to be drawn came. */
  private cameMs = Infinity;

  /**
   * @param draw what is to be done when there is something new.
   * @param drawn resolves when the page has done what came of it.
   */
  constructor(
    private readonly draw: () => void,
    private readonly drawn: () => Promise<void> = nextTask,
    private readonly now: () => number = () => performance.now(),
  ) {}

  /** There is something new, which came then. */
  ask(cameMs = this.now()): void {
    this.wanted = true;
    this.cameMs = Math.min(this.cameMs, cameMs);
    if (!this.running) void this.run();
  }

  /** How old what is shown will be when what waits is drawn, if that were now; 0 where nothing waits. */
  behindMs(): number {
    return this.wanted ? this.now() - this.cameMs + this.cost : 0;
  }

  private async run(): Promise<void> {
    this.running = true;
    try {
      while (this.wanted) {
        this.wanted = false;
        this.cameMs = Infinity;
        const began = this.now();
        this.draw();
        await this.drawn();
        const took = this.now() - began;
        this.cost = Math.min(took, this.before);
        this.before = took;
        // A hidden page's timers may be late by a minute, and nobody presses keys there.
        if (!hidden()) await pause(Math.max(LEAST_MS - took, Math.min(MOST_MS, (SHARE - 1) * this.cost)));
      }
    } finally {
      this.running = false;
    }
  }
}

function hidden(): boolean {
  return typeof document !== 'undefined' && document.hidden;
}

function pause(ms: number): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, ms));
}

function nextTask(): Promise<void> {
  return new Promise((resolve) => {
    const { port1, port2 } = new MessageChannel();
    port1.onmessage = () => resolve();
    port2.postMessage(null);
  });
}
