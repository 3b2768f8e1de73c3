export const SPEEDS = [0.5, 1, 2, 4] as const;
export type Speed = (typeof SPEEDS)[number];

/** A moment of a recording, and how it moves on. */
export class Player {
  atS = $state(0);
  playing = $state(false);
  speed = $state<Speed>(1);
  fromS = $state(0);
  toS = $state(0);
  private request = 0;
  private lastMs: number | null = null;

  load(fromS: number, toS: number, atS: number): void {
    this.pause();
    this.fromS = fromS;
    this.toS = toS;
    this.atS = atS;
  }

  /** Takes other ends of the same recording; what plays goes on. */
  grow(fromS: number, toS: number): void {
    this.fromS = fromS;
    this.toS = toS;
    this.seek(this.atS);
  }

  seek(atS: number): void {
    this.atS = Math.min(this.toS, Math.max(this.fromS, atS));
  }

  toggle(): void {
    if (this.playing) this.pause();
    else this.play();
  }

  play(): void {
    if (this.toS <= this.fromS) return;
    if (this.atS >= this.toS - 1e-3) this.atS = this.fromS;
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
    const passedS = this.lastMs === null ? 0 : (nowMs - this.lastMs) / 1000;
    this.lastMs = nowMs;
    this.seek(this.atS + passedS * this.speed);
    if (this.atS >= this.toS) this.pause();
    else this.request = requestAnimationFrame(this.step);
  };
}
