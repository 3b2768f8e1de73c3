const LONG_S = 15;
const SHARE = 0.06;

/** A wait in which nothing was recorded, with its place on the axis. */
export interface Fold {
  fromS: number;
  toS: number;
  /** Shares of the axis, 0 to 1. */
  left: number;
  width: number;
}

interface Piece {
  fromS: number;
  toS: number;
  at: number;
  long: number;
  folded: boolean;
}

/**
 * Where a session's moments lie on its slider and in its plots.
 *
 * One second is as long as another where something is recorded. A question that waits for a quarter of an hour before a
 * motion of twenty seconds would leave that motion no room: so a wait of more than 15 s in which neither an event nor a
 * row of telemetry lies takes 6 % of the rest, however long it was.
 */
export class Axis {
  /** How long the axis is, in seconds of what is drawn to scale. */
  readonly length: number;
  readonly folds: readonly Fold[];
  private readonly pieces: readonly Piece[];

  /** `moments` are those at which something was recorded, s, in any order; the axis goes from `fromS` to `toS`. */
  constructor(
    readonly fromS: number,
    readonly toS: number,
    moments: readonly number[] = [],
  ) {
    const within = moments.filter((at) => at > fromS && at < toS).sort((a, b) => a - b);
    const marks = [fromS, ...within, toS];
    const gaps = marks.slice(1).map((to, k) => ({ fromS: marks[k] ?? to, toS: to }));
    const [long, short] = [gaps.filter(isLong), gaps.filter((gap) => !isLong(gap))];
    const drawn = short.reduce((sum, gap) => sum + gap.toS - gap.fromS, 0);
    // Where next to nothing but a wait was recorded, there is nothing to make room for.
    const folding = drawn > 0.5;
    const each = Math.max(1, SHARE * drawn);
    const pieces: Piece[] = [];
    for (const gap of folding ? gaps : [{ fromS, toS }]) {
      const folded = folding && long.includes(gap);
      const last = pieces.at(-1);
      if (!folded && last?.folded === false) Object.assign(last, { toS: gap.toS, long: gap.toS - last.fromS });
      else pieces.push({ ...gap, at: endOf(last), long: folded ? each : gap.toS - gap.fromS, folded });
    }
    this.pieces = pieces;
    this.length = Math.max(0.001, endOf(pieces.at(-1)));
    this.folds = pieces
      .filter(({ folded }) => folded)
      .map((piece) => ({ fromS: piece.fromS, toS: piece.toS, left: piece.at / this.length, width: piece.long / this.length }));
  }

  /** Returns where a moment lies on the axis, 0 to `length`. */
  place(atS: number): number {
    const piece = this.pieces.find(({ toS }) => atS <= toS) ?? this.pieces.at(-1);
    if (piece === undefined || piece.toS <= piece.fromS) return 0;
    const share = Math.min(1, Math.max(0, (atS - piece.fromS) / (piece.toS - piece.fromS)));
    return piece.at + share * piece.long;
  }

  /** Returns the moment at a place on the axis, s. */
  at(place: number): number {
    const piece = this.pieces.find(({ at, long }) => place <= at + long) ?? this.pieces.at(-1);
    if (piece === undefined || piece.long <= 0) return this.fromS;
    const share = Math.min(1, Math.max(0, (place - piece.at) / piece.long));
    return piece.fromS + share * (piece.toS - piece.fromS);
  }

  /** Returns rows as they are drawn: at their places, and with a gap where for longer than `goodS` nothing was recorded. */
  drawn(times: readonly number[], columns: readonly (readonly (number | null)[])[], goodS = LONG_S): { times: number[]; columns: (number | null)[][] } {
    const cuts = times.flatMap((at, k) => (k > 0 && at - (times[k - 1] ?? at) > goodS ? [k] : []));
    const cut = <T>(values: readonly T[], between: (k: number) => T): T[] => {
      const parts = [0, ...cuts].map((from, n) => [...(n === 0 ? [] : [between(from)]), ...values.slice(from, cuts[n])]);
      return parts.flat();
    };
    const middle = (k: number): number => ((times[k - 1] ?? 0) + (times[k] ?? 0)) / 2;
    return { times: cut(times, middle).map((at) => this.place(at)), columns: columns.map((values) => cut(values, () => null)) };
  }
}

function endOf(piece: Piece | undefined): number {
  return piece === undefined ? 0 : piece.at + piece.long;
}

function isLong({ fromS, toS }: { fromS: number; toS: number }): boolean {
  return toS - fromS > LONG_S;
}
