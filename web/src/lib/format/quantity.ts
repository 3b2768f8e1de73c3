import type { InputSchema, Json, Params } from '../api/documents';
import { entryOf } from './entry';
import { plain } from './plain';

/** Units by the ending of a quantity's name. */
const UNITS: readonly (readonly [string, string])[] = [
  ['_mps2', 'm/s²'],
  ['_mps', 'm/s'],
  ['_nm', 'N·m'],
  ['_n', 'N'],
  ['_m', 'm'],
  ['_rad', 'rad'],
  ['_kg', 'kg'],
  ['_ms', 'ms'],
  ['_s', 's'],
];

const LABELS: Record<string, string> = {
  speed_mps: 'Speed',
  force_n: 'Grip force',
  tcp_speed_mps: 'Tool speed',
  clearance_m: 'Clearance',
  object_id: 'Object',
  dwell_s: 'Dwell',
  x_m: 'x',
  y_m: 'y',
  yaw_rad: 'Heading',
};

export function unitOf(name: string): string {
  return UNITS.find(([ending]) => name.endsWith(ending))?.[1] ?? '';
}

/** `Grip force` for `force_n`; otherwise the name in words, without its unit. */
export function labelOf(name: string): string {
  const known = entryOf(LABELS, name);
  if (known !== undefined) return known;
  const ending = UNITS.find(([unit]) => name.endsWith(unit))?.[0] ?? '';
  const words = plain(name.slice(0, name.length - ending.length)).replaceAll('_', ' ');
  return words.charAt(0).toUpperCase() + words.slice(1);
}

/** A force is the grip's or the contact's, by the limit it falls under. */
export function labelFor(param: string, schema: Pick<InputSchema, 'x-limit'> | undefined): string {
  return param === 'force_n' && schema?.['x-limit'] === 'contact_force_n' ? 'Contact force' : labelOf(param);
}

/** A number with as many digits as its unit deserves. */
export function number(value: number, unit: string): string {
  if (!Number.isFinite(value)) return '–';
  if (unit === 'N' || unit === 'N·m' || unit === 'ms') return trimmed(value, Math.abs(value) < 100 ? 1 : 0);
  return value.toFixed(2);
}

function trimmed(value: number, digits: number): string {
  return value.toFixed(digits).replace(/\.0$/, '');
}

/** A parameter's value in words; numbers by the unit of their name, with six digits where that would round them: what is approved is approved as it stands there. */
export function valueOf(name: string, value: Json | undefined): string {
  if (value === undefined || value === null) return '–';
  if (typeof value === 'number') {
    const text = number(value, unitOf(name));
    return Number.isFinite(value) && Number(text) !== value ? String(Number(value.toPrecision(6))) : text;
  }
  if (typeof value === 'string') return plain(value);
  return typeof value === 'boolean' ? (value ? 'yes' : 'no') : plain(JSON.stringify(value));
}

export function withUnit(name: string, value: Json | undefined): string {
  const unit = typeof value === 'number' ? unitOf(name) : '';
  return unit === '' ? valueOf(name, value) : `${valueOf(name, value)} ${unit}`;
}

/** The numbers among parameters, for a glance: `40 N, 0.10 m/s`. */
export function figuresOf(params: Params): string {
  const names = Object.keys(params).filter((name) => typeof params[name] === 'number').sort();
  return names.map((name) => withUnit(name, params[name])).join(', ');
}
