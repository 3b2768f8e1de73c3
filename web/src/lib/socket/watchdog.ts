/** How long the link may be silent before the console says that it is down. The server beats every 200 ms. */
export const SILENT_MS = 700;
/** How far what comes may lag behind before it is no longer the present: so long a ping may wait for its answer. */
export const LATE_MS = 1_000;
/** How long a silent socket is waited for before it is given up and another is opened. */
export const GIVE_UP_MS = 2_500;

/** `connecting`: nothing of this socket's own yet, as no snapshot has come; `late`: what comes is no longer the present. */
export type LinkState = 'connecting' | 'up' | 'late' | 'down';

/** Decides from times alone whether the link is up; the caller brings the clock. */
export class Watchdog {
  private heardMs: number | null = null;
  private openedMs: number;

  constructor(nowMs: number) {
    this.openedMs = nowMs;
  }

  /** A new socket is being opened: what the last one said no longer counts. */
  opened(nowMs: number): void {
    this.openedMs = nowMs;
    this.heardMs = null;
  }

  heard(nowMs: number): void {
    this.heardMs = nowMs;
  }

  state(nowMs: number): LinkState {
    if (this.heardMs === null) return nowMs - this.openedMs > SILENT_MS ? 'down' : 'connecting';
    return nowMs - this.heardMs > SILENT_MS ? 'down' : 'up';
  }

  /** Says whether waiting for this socket any longer is pointless. */
  spent(nowMs: number): boolean {
    return nowMs - (this.heardMs ?? this.openedMs) > GIVE_UP_MS;
  }
}

/** A link that was lost twice within so long comes and goes. */
const RESTLESS_MS = 5_000;
/** So long such a link has to hold before it is called up again. */
export const STEADY_MS = 2_000;
/** Down it is called within a second of silence all the same. */
const TRUSTED_AFTER_MS: Partial<Record<LinkState, number>> = { up: STEADY_MS, down: 200 };

/**
 * What is shown of a link that comes and goes: nothing that does so, too. One that was lost once is up as soon as it is;
 * one that was lost again just then is `late` until it has held for a while, for nobody can read, nor press, what jumps.
 */
export class Steady {
  private lostMs: number[] = [];
  private last: LinkState = 'connecting';
  /** Since when it has been in the state it is in. */
  private sinceMs = 0;

  take(state: LinkState, nowMs: number): LinkState {
    if (state !== this.last) {
      if (this.last === 'up') this.lostMs.push(nowMs);
      this.last = state;
      this.sinceMs = nowMs;
    }
    this.lostMs = this.lostMs.filter((at) => nowMs - at < RESTLESS_MS);
    const least = TRUSTED_AFTER_MS[state] ?? 0;
    return this.lostMs.length < 2 || nowMs - this.sinceMs >= least ? state : 'late';
  }
}

/** Pause before the n-th attempt in a row, with a random part so that consoles do not come back all at once. */
export function retryMs(attempt: number, random: number): number {
  return Math.min(4_000, 250 * 2 ** Math.min(attempt, 5)) * (0.7 + 0.6 * random);
}
