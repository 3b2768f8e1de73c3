/** The server's word for a moment, ms since the epoch; NaN where it is none. */
export function serverMs(at: string | number): number {
  return typeof at === 'number' ? at * 1000 : Date.parse(at);
}

/** By so much no clock wanders from another within a minute. */
const SLEPT_MS = 2_000;
/** Within so long after a sleep the server tells the time, if it is heard; and it does so at least this often. */
const TOLD_BY_MS = 1_000;
const OFTEN_MS = 500;

/** The time everything on screen is told by: the server's wall clock, as far as its beats let us know it. */
class Clock {
  /** Between beats it is this computer's time since the page was opened: its wall clock may be set meanwhile. */
  private offsetMs = performance.timeOrigin;
  /** Server's wall clock, ms since the epoch; steps four times a second. */
  nowMs = $state(this.read());
  private synced = false;
  private syncedMs = 0;
  /** How far this computer's wall clock is ahead of that time: in a sleep it alone goes on. */
  private aheadMs = Date.now() - performance.now();

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
    this.syncedMs = performance.now();
    if (Math.abs(this.read() - this.nowMs) > OFTEN_MS) this.step(); // a hidden page's timers may be late by a minute, and its title counts down
  }

  read(): number {
    return performance.now() + this.offsetMs;
  }

  private step(): void {
    const slept = Date.now() - performance.now() - this.aheadMs;
    this.aheadMs += slept;
    if (slept > SLEPT_MS) this.woke(this.offsetMs + slept);
    this.nowMs = this.read();
  }

  /** It slept, or its clock was set: whoever hears the server knows which. */
  private woke(offsetMs: number): void {
    setTimeout(() => {
      if (performance.now() - this.syncedMs > OFTEN_MS) this.offsetMs = Math.max(this.offsetMs, offsetMs);
    }, TOLD_BY_MS);
  }
}

export const clock = new Clock();
