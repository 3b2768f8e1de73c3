import type { LogEvent, Telemetry } from '../api/documents';
import { Axis } from './axis';

const TICK_S = 0.01;

/** An event with its place on the session's own clock, s; 0 is the first row of telemetry, or else the first event. */
export interface Placed {
  event: LogEvent;
  atS: number;
  /** The cell stamped it with a control tick; others are placed by the wall clock between those. */
  exact: boolean;
}

export interface Timeline {
  placed: Placed[];
  fromS: number;
  toS: number;
  /** Cell time, s, of 0. */
  zeroS: number;
  axis: Axis;
}

/**
 * Puts a trace on one clock.
 *
 * Rows and what the cell reports bear the cell's control time, which a simulation may run faster or slower than the
 * wall clock. What the server records bears the wall clock alone, so it is placed between its neighbours in proportion,
 * and before the first and after the last of them at the wall clock's own pace.
 */
export function timelineOf(events: readonly LogEvent[], telemetry: Telemetry | null): Timeline {
  const anchors = anchorsOf(events);
  const times = telemetry?.columns['time_s'] ?? [];
  const firstRow = times[0] ?? null;
  const zeroS = firstRow ?? anchors[0]?.cellS ?? 0;
  const firstWallS = events[0] === undefined ? 0 : wallOf(events[0]);
  const cellOf = (wallS: number): number => interpolate(anchors, wallS) ?? zeroS + wallS - firstWallS;
  const placed = events.map((event) => {
    const tick = event.body['tick'];
    const exact = typeof tick === 'number';
    return { event, atS: (exact ? tick * TICK_S : cellOf(wallOf(event))) - zeroS, exact };
  });
  // The record's order is the truth where two clocks meet; time never runs backwards along it.
  let latest = -Infinity;
  const ordered = placed.map((item) => {
    latest = Math.max(item.atS, latest);
    return { ...item, atS: latest };
  });
  const rows = times.map((time) => (time ?? zeroS) - zeroS);
  const { fromS, toS } = endsOf(ordered, rows.at(-1) ?? 0);
  const axis = new Axis(fromS, toS, [...ordered.map(({ atS }) => atS), ...rows]);
  return { placed: ordered, fromS, toS, zeroS, axis };
}

/** Whether a trace says that telemetry was kept: its digest is an event, behind the session's end. */
export function hasTelemetry(events: readonly LogEvent[]): boolean {
  return events.some((event) => event.kind === 'telemetry');
}

function anchorsOf(events: readonly LogEvent[]): { wallS: number; cellS: number }[] {
  return events.flatMap((event) => {
    const tick = event.body['tick'];
    return typeof tick === 'number' ? [{ wallS: wallOf(event), cellS: tick * TICK_S }] : [];
  });
}

function endsOf(ordered: readonly Placed[], lastRowS: number): { fromS: number; toS: number } {
  return { fromS: Math.min(0, ordered[0]?.atS ?? 0), toS: Math.max(lastRowS, ordered.at(-1)?.atS ?? 0) };
}

function wallOf(event: LogEvent): number {
  const cellWall = event.body['cell_at_s'];
  return typeof cellWall === 'number' ? cellWall : Date.parse(event.at) / 1000;
}

function interpolate(anchors: readonly { wallS: number; cellS: number }[], wallS: number): number | null {
  const first = anchors[0];
  const last = anchors.at(-1);
  if (first === undefined || last === undefined) return null;
  if (wallS <= first.wallS) return first.cellS - (first.wallS - wallS);
  if (wallS >= last.wallS) return last.cellS + (wallS - last.wallS);
  const after = anchors.findIndex((anchor) => anchor.wallS >= wallS);
  const [a, b] = [anchors[after - 1] ?? first, anchors[after] ?? last];
  const share = b.wallS === a.wallS ? 1 : (wallS - a.wallS) / (b.wallS - a.wallS);
  return a.cellS + share * (b.cellS - a.cellS);
}

/** The newest row at or before a moment, s on the session's clock; the first one before all. -1 without rows. */
export function rowAt(telemetry: Telemetry | null, zeroS: number, atS: number): number {
  const times = telemetry?.columns['time_s'] ?? [];
  if (times.length === 0) return -1;
  let [low, high] = [0, times.length - 1];
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if ((times[middle] ?? 0) - zeroS <= atS + 1e-9) low = middle;
    else high = middle - 1;
  }
  return low;
}

/** The last event at or before a moment; -1 before the first. */
export function eventAt(placed: readonly Placed[], atS: number): number {
  let found = -1;
  for (const [k, item] of placed.entries()) {
    if (item.atS <= atS + 1e-6) found = k;
    else break;
  }
  return found;
}

/** Where a step goes: to the next or the last moment that something happened, and at the ends, to the end. */
export function stepTo(timeline: Timeline, atS: number, direction: 1 | -1): number {
  const moments = [timeline.fromS, ...timeline.placed.map(({ atS: at }) => at), timeline.toS];
  const there = direction > 0 ? moments.filter((at) => at > atS + 0.005) : moments.filter((at) => at < atS - 0.005);
  return direction > 0 ? Math.min(timeline.toS, ...there) : Math.max(timeline.fromS, ...there);
}

/** `+12.4 s`, `−3.0 s` from the first row. */
export function offset(atS: number): string {
  return `${atS < -0.05 ? '−' : '+'}${Math.abs(atS).toFixed(1)} s`;
}
