import type { LogEvent, Telemetry } from '../api/documents';
import { Axis } from './axis';

const TICK_S = 0.01;
const LEAST_GOOD_S = 0.1;
/** A slider gives a moment back a little less exactly than it took it. */
const SAME_S = 1e-6;

/** An event with its place on the session's own clock, s; 0 is the first row of telemetry, or else the first event. */
export interface Placed {
  event: LogEvent;
  atS: number;
  /** The cell stamped it with a control tick; others are placed by the wall clock between those. */
  exact: boolean;
}

export interface Timeline {
  placed: Placed[];
  /** From the first to the last of what was recorded; a reviewer may take days. */
  fromS: number;
  toS: number;
  /** Cell time, s, of 0. */
  zeroS: number;
  /** From the launch to the end of what ran: what a person took to answer before, or to review after it, is none of it. */
  axis: Axis;
}

/**
 * Puts a trace on one clock.
 *
 * Rows and what the cell reports bear the cell's control time, which a simulation may run faster or slower than the
 * wall clock. What the server records bears the wall clock alone, so it is placed between its neighbours in proportion,
 * and before the first and after the last of them at the wall clock's own pace. `aheadS` is what `aheadOf` has found.
 */
export function timelineOf(events: readonly LogEvent[], telemetry: Telemetry | null, aheadS = aheadOf(events, telemetry) ?? 0): Timeline {
  const times = telemetry?.columns['time_s'] ?? [];
  const firstRow = times[0] ?? null;
  const timeOf = (tick: number): number => tick * TICK_S + aheadS;
  const anchors = anchorsOf(events, timeOf);
  const zeroS = firstRow ?? anchors[0]?.cellS ?? 0;
  const firstWallS = events[0] === undefined ? 0 : wallOf(events[0]);
  const cellOf = (wallS: number): number => interpolate(anchors, wallS) ?? zeroS + wallS - firstWallS;
  const placed = events.map((event) => {
    const tick = event.body['tick'];
    const exact = typeof tick === 'number';
    return { event, atS: (exact ? timeOf(tick) : cellOf(wallOf(event))) - zeroS, exact };
  });
  // The record's order is the truth where two clocks meet; time never runs backwards along it.
  let latest = -Infinity;
  const ordered = placed.map((item) => {
    latest = Math.max(item.atS, latest);
    return { ...item, atS: latest };
  });
  const rows = times.map((time) => (time ?? zeroS) - zeroS);
  return { placed: ordered, zeroS, ...endsOf(ordered, rows) };
}

/** In how many parts a trace tells of telemetry, those included that were not kept: behind the session's end, and where a server ended before. */
export function partsOf(events: readonly LogEvent[]): number {
  return events.filter(isTelemetry).length;
}

const isTelemetry = (event: LogEvent): boolean => event.kind === 'telemetry';
const launched = (event: LogEvent): boolean => event.kind === 'launch' && (event.body['refused'] ?? '') === '';

/** The first part with rows, which is where a replay begins: a server that ends soon after a launch has had none yet. */
export function beginningOf(events: readonly LogEvent[]): number {
  return Math.max(0, events.filter(isTelemetry).findIndex(({ body }) => body['rows'] !== 0)) + 1;
}

/**
 * How far a robot's clock, which rows bear, is ahead of the ticks of its cell, s, through all of a session.
 *
 * The first row of all is of the tick behind the launch; null where telemetry does not hold it.
 */
export function aheadOf(events: readonly LogEvent[], telemetry: Telemetry | null): number | null {
  const tick = events.find(launched)?.body['tick'];
  const first = telemetry?.part === beginningOf(events) ? telemetry.columns['time_s']?.[0] : null;
  return typeof tick === 'number' && first != null ? first - (tick + 1) * TICK_S : null;
}

/** A moment that both clocks have; `untilS` is the latest that the wall clock had shown by then. */
interface Anchor {
  wallS: number;
  cellS: number;
  untilS: number;
}

function anchorsOf(events: readonly LogEvent[], timeOf: (tick: number) => number): Anchor[] {
  let untilS = -Infinity;
  return events.flatMap((event) => {
    const tick = event.body['tick'];
    if (typeof tick !== 'number') return [];
    const wallS = wallOf(event);
    untilS = Math.max(untilS, wallS);
    return [{ wallS, cellS: timeOf(tick), untilS }];
  });
}

/** The axis is of what ran, or where nothing did, of what was decided. */
function endsOf(ordered: readonly Placed[], rows: readonly number[]): Pick<Timeline, 'axis' | 'fromS' | 'toS'> {
  const begun = ordered.find(({ event }) => launched(event)) ?? ordered[0];
  const over = ordered.findLast(({ event }) => event.kind === 'outcome') ?? ordered.at(-1);
  const [fromS, toS] = [Math.min(begun?.atS ?? 0, rows[0] ?? Infinity), Math.max(over?.atS ?? 0, rows.at(-1) ?? -Infinity)];
  const moments = [...ordered.map(({ atS }) => atS), ...rows];
  const axis = new Axis(fromS, Math.max(fromS, toS), moments);
  return { axis, fromS: Math.min(fromS, ...ordered.slice(0, 1).map(({ atS }) => atS)), toS: Math.max(axis.toS, ...ordered.slice(-1).map(({ atS }) => atS)) };
}

function wallOf(event: LogEvent): number {
  const cellWall = event.body['cell_at_s'];
  return typeof cellWall === 'number' ? cellWall : Date.parse(event.at) / 1000;
}

function interpolate(anchors: readonly Anchor[], wallS: number): number | null {
  const first = anchors[0];
  const last = anchors.at(-1);
  if (first === undefined || last === undefined) return null;
  if (wallS <= first.wallS) return first.cellS - (first.wallS - wallS);
  if (wallS >= last.wallS) return last.cellS + (wallS - last.wallS);
  const after = firstBy(anchors, ({ untilS }) => untilS >= wallS);
  const [a, b] = [anchors[after - 1] ?? first, anchors[after] ?? last];
  const share = b.wallS === a.wallS ? 1 : (wallS - a.wallS) / (b.wallS - a.wallS);
  return a.cellS + share * (b.cellS - a.cellS);
}

/** Where the first of those in order is that are past something; behind the last where none is. */
function firstBy<T>(ordered: readonly T[], past: (item: T) => boolean): number {
  let [low, high] = [0, ordered.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    const item = ordered[middle];
    if (item !== undefined && past(item)) high = middle;
    else low = middle + 1;
  }
  return low;
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

/** How long a row is good for, s: until well past the next one would have come, also where it is one drawn of many. */
export function goodForS(telemetry: Telemetry | null): number {
  const times = telemetry?.columns['time_s'] ?? [];
  const apart = times.slice(1).map((at, k) => (at ?? 0) - (times[k] ?? 0)).sort((a, b) => a - b);
  return Math.max(LEAST_GOOD_S * (telemetry?.every ?? 1), 3 * (apart[apart.length >> 1] ?? 0));
}

/** Whether a row, as `rowAt` finds it, is a reading of that moment; at others, and in gaps, nothing was measured. */
export function measuredAt(telemetry: Telemetry | null, row: number, zeroS: number, atS: number, goodS: number): boolean {
  const at = telemetry?.columns['time_s']?.[row];
  if (at == null) return false;
  const agoS = atS - (at - zeroS);
  return agoS >= -SAME_S && agoS <= goodS;
}

/** The last event at or before a moment, or of those at that very one, the one that was picked; -1 before the first. */
export function eventAt(placed: readonly Placed[], atS: number, picked: number | null = null): number {
  const latest = firstBy(placed, (item) => item.atS > atS + SAME_S) - 1;
  const from = firstBy(placed, (item) => item.atS >= atS - SAME_S);
  const found = picked === null ? -1 : placed.slice(from, latest + 1).findIndex(({ event }) => event.seq === picked);
  return found < 0 ? latest : from + found;
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

/** Which side of what the axis covers a moment lies on; empty within it. */
export function outside({ axis }: Timeline, atS: number): 'before the launch' | 'after the end' | '' {
  if (atS < axis.fromS - SAME_S) return 'before the launch';
  return atS > axis.toS + SAME_S ? 'after the end' : '';
}
