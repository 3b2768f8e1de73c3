/** After so long without a word nothing is known of what lay between. */
export const GAP_S = 1;

/** The last seconds of one gauge, for its plot: at most so many points, oldest first; `null` where nothing is known. */
export class History {
  readonly times: number[] = [];
  readonly values: (number | null)[] = [];
  readonly limits: (number | null)[] = [];

  constructor(
    private readonly keepS: number,
    private readonly everyS: number,
  ) {}

  push(atS: number, value: number | null, limit: number | null): void {
    const last = this.times.at(-1);
    if (last !== undefined && atS < last) this.clear(); // the cell's clock went back: another cell, another run
    if (last !== undefined && atS >= last && atS - last < this.everyS) return;
    this.breakOff(atS);
    this.put(atS, value, limit);
    let old = 0;
    while ((this.times[old] ?? atS) < atS - this.keepS) old += 1;
    if (old > 0) for (const column of [this.times, this.values, this.limits]) column.splice(0, old);
  }

  /** No line leads across a time of which nothing is known. */
  private breakOff(atS: number): void {
    const last = this.times.at(-1) ?? atS;
    if (atS - last > GAP_S) this.put(last + this.everyS, null, null);
  }

  private put(atS: number, value: number | null, limit: number | null): void {
    this.times.push(atS);
    this.values.push(value);
    this.limits.push(limit);
  }

  clear(): void {
    this.times.length = this.values.length = this.limits.length = 0;
  }
}
