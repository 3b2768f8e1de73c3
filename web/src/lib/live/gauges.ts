import type { Cell, Invocation } from '../api/documents';
import { number } from '../format/quantity';

/** A gauge as it is drawn: its newest value, its limit, and on which side of it things are wrong. */
export interface GaugeSpec {
  key: string;
  label: string;
  unit: string;
  source: string;
  limit: string | null;
  side: 'least' | 'most' | 'none';
  /** Top of the scale while the values stay below it. */
  span: number;
}

const SEPARATION: GaugeSpec = { key: 'separation', label: 'Separation', unit: 'm', source: 'separation_m', limit: 'protective_separation_m', side: 'least', span: 3 };
const TOOL: GaugeSpec = { key: 'speed', label: 'Tool speed', unit: 'm/s', source: 'tcp_speed_mps', limit: 'tcp_speed_limit_mps', side: 'most', span: 0.3 };
const BASE: GaugeSpec = { key: 'speed', label: 'Base speed', unit: 'm/s', source: 'base_speed_mps', limit: 'base_speed_limit_mps', side: 'most', span: 0.4 };
const GRIP: GaugeSpec = { key: 'grip', label: 'Grip force', unit: 'N', source: 'grip_force_n', limit: 'grip_force_limit_n', side: 'most', span: 25 };
const CONTACT: GaugeSpec = { key: 'contact', label: 'Contact force', unit: 'N', source: 'contact_force_n', limit: 'contact_force_limit_n', side: 'most', span: 25 };
const PROGRESS: GaugeSpec = { key: 'progress', label: 'Progress', unit: '%', source: 'progress', limit: null, side: 'none', span: 1 };

const DRIVING: readonly GaugeSpec[] = [SEPARATION, BASE, GRIP, CONTACT, PROGRESS];
const HANDLING: readonly GaugeSpec[] = [SEPARATION, TOOL, GRIP, CONTACT, PROGRESS];
/** By hand both move, whatever ran before; and nobody knows how much is left to do. */
const BY_HAND: readonly GaugeSpec[] = [SEPARATION, BASE, TOOL, GRIP, CONTACT];
const DRIVES = new Set(['navigate_to', 'transport_object', 'reposition_base', 'takeover']);

/** The gauges worth watching for what runs: the speed that matters is the base's or the tool's, and both while somebody drives. */
export function gaugesFor(session: Invocation | null, byHand: boolean): readonly GaugeSpec[] {
  if (byHand) return BY_HAND;
  return session !== null && DRIVES.has(session.capability) ? DRIVING : HANDLING;
}

export interface Reading {
  value: number | null;
  limit: number | null;
  beyond: boolean;
  near: boolean;
}

/** Reads a gauge out of a frame's numbers; not a number is not known. */
export function readGauge(spec: GaugeSpec, names: readonly string[], values: ArrayLike<number>): Reading {
  const at = (name: string | null): number | null => {
    const value = name === null ? undefined : values[names.indexOf(name)];
    return value === undefined || !Number.isFinite(value) ? null : value;
  };
  const value = at(spec.source);
  const limit = at(spec.limit);
  if (value === null || limit === null || spec.side === 'none') return { value, limit, beyond: false, near: false };
  // A violation is beyond 1.05 times a limit, as the watcher counts it; separation has no such margin.
  const beyond = spec.side === 'least' ? value < limit : value > limit * 1.05;
  const near = spec.side === 'least' ? value < limit * 1.15 : value > limit * 0.98;
  return { value, limit, beyond, near };
}

/** Motions that are over say nothing of a session that failed, or asks: nothing is done that was not verified. */
export function unfinished(spec: GaugeSpec, reading: Reading, session: Pick<Invocation, 'status' | 'outcome'> | null): Reading {
  const failed = session !== null && (session.status === 'escalated' || session.status === 'failed');
  return failed && spec.key === PROGRESS.key && reading.value !== null && reading.value > 0.995 ? { ...reading, value: null } : reading;
}

export function valueText(spec: GaugeSpec, value: number | null): string {
  if (value === null) return '–';
  if (spec.unit === '%') return String(Math.round(value * 100));
  return spec.unit === 'N' && Math.abs(value) < 100 ? value.toFixed(1) : number(value, spec.unit); // a digit that comes and goes flickers
}

/** Says why a gauge of a cell has nothing to measure; null where that is not known. */
export function noneOf(spec: GaugeSpec, cell: Pick<Cell, 'online' | 'facts'> | null): string | null {
  return spec.key === SEPARATION.key && cell?.online === true && cell.facts?.people_count === 0 ? 'nobody seen' : null;
}

export function limitText(spec: GaugeSpec, limit: number | null): string {
  if (limit === null) return '';
  return `at ${spec.side} ${number(limit, spec.unit)} ${spec.unit}`;
}
