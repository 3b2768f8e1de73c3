import { Axis } from './axis';

export const SPEEDS = [0.5, 1, 2, 4] as const;
export type Speed = (typeof SPEEDS)[number];

/** Frames come sixty times a second. After a longer time without one the tab was hidden or the machine slept: nobody saw what passed. */
const UNSEEN_S = 2;

/** A recording: what is played of it, and where the first and the last of what was recorded lie. */
export interface Recording {
  axis: Axis;
  fromS: number;
  toS: number;
}

/** A moment of a recording, and how it moves on. What came before or after it can be looked at, and is not played. */
export class Player {
  atS = $state(0);
  playing = $state(false);
  speed = $state<Speed>(1);
  private record = $state.raw<Recording>({ axis: new Axis(0, 0), fromS: 0, toS: 0 });
  private request = 0;
  private lastMs: number | null = null;

  load(record: Recording, atS: number): void {
    this.pause();
    this.record = record;
    this.atS = atS;
  }

  /** Takes other ends of the same recording; what plays goes on. */
  grow(record: Recording): void {
    this.record = record;
    this.seek(this.atS);
  }

  seek(atS: number): void {
    this.atS = Math.min(this.record.toS, Math.max(this.record.fromS, atS));
  }

  toggle(): void {
    if (this.playing) this.pause();
    else this.play();
  }

  play(): void {
    const { fromS, toS } = this.record.axis;
    if (toS <= fromS) return;
    if (this.atS >= toS - 1e-3) this.atS = fromS;
    this.playing = true;
    this.lastMs = null;
    this.request = requestAnimationFrame(this.step);
  }

  pause(): void {
    this.playing = false;
    cancelAnimationFrame(this.request);
  }

  faster(by: 1 | -1): void {
    const next = SPEEDS[SPEEDS.indexOf(this.speed) + by];
    if (next !== undefined) this.speed = next;
  }

  private readonly step = (nowMs: number): void => {
    if (!this.playing) return;
    const sinceS = this.lastMs === null ? 0 : (nowMs - this.lastMs) / 1000;
    const passedS = sinceS > UNSEEN_S ? 0 : sinceS;
    this.lastMs = nowMs;
    // Nobody sits through a wait of minutes: what is folded goes by as fast as it is wide.
    const { axis } = this.record;
    this.seek(axis.at(axis.place(this.atS) + passedS * this.speed));
    if (this.atS >= axis.toS - 1e-6) this.pause();
    else this.request = requestAnimationFrame(this.step);
  };
}
