/** The server's word for a moment, ms since the epoch; NaN where it is none. */
export function serverMs(at: string | number): number {
  return typeof at === 'number' ? at * 1000 : Date.parse(at);
}

/** The time everything on screen is told by: the server's wall clock, as far as its beats let us know it. */
class Clock {
  /** Between beats it is this computer's time since the page was opened: its wall clock may be set meanwhile. */
  private offsetMs = performance.timeOrigin;
  /** Server's wall clock, ms since the epoch; steps four times a second. */
  nowMs = $state(this.read());
  private synced = false;

  constructor() {
    setInterval(() => this.step(), 250);
  }

  /** Takes the server's time from a message that just came. */
  sync(at: string | number): void {
    const ms = serverMs(at);
    if (!Number.isFinite(ms)) return;
    const offset = ms - performance.now();
    // The least delayed message tells best; drift and a server's clock that is set still come through.
    this.offsetMs = !this.synced || offset > this.offsetMs || this.offsetMs - offset > 500 ? offset : this.offsetMs;
    this.synced = true;
  }

  read(): number {
    return performance.now() + this.offsetMs;
  }

  private step(): void {
    this.nowMs = this.read();
  }
}

export const clock = new Clock();
