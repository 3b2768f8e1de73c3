import type { InputSchema, Json, Params, Telemetry } from '../api/documents';
import { entryOf } from '../format/entry';
import type { PoseFrame } from '../socket/frame';
import { bodiesOf, toolError, type Posture } from './kinematics';
import type { Placed } from './timeline';

const FAR_M = 90;
/** A sighting older than this says nothing of where somebody is; the tracker's are recorded five times a second. */
const FRESH_S = 0.5;
const SAME_S = 1e-4;
const PERSON = /^person_(\d+)_/;
/** How high the bodies of a figure are hung up, as the simulation builds it. */
const HIP_M = 0.90;
const TRUSTED_M = 0.02;

const at = (telemetry: Telemetry, name: string, row: number): number | null => telemetry.columns[name]?.[row] ?? null;

/** What the robot's posture was at a row; null where telemetry lacks a part of it. */
export function postureAt(telemetry: Telemetry, row: number): Posture | null {
  const wanted = ['base_x_m', 'base_y_m', 'base_yaw_rad', 'q1_rad', 'q2_rad', 'q3_rad', 'q4_rad', 'q5_rad', 'q6_rad'];
  const values = wanted.map((name) => at(telemetry, name, row));
  const numbers = values.filter((value): value is number => value !== null && Number.isFinite(value));
  if (numbers.length < wanted.length) return null;
  const [x = 0, y = 0, yaw = 0, ...joints] = numbers;
  return { base: [x, y, yaw], joints, gripWidthM: at(telemetry, 'grip_width_m', row) ?? 0 };
}

/** Where the last of rising times stands that is not after a moment; −1 before the first. */
function lastUntil(times: readonly number[], moment: number): number {
  let low = 0;
  let high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if ((times[middle] ?? Infinity) <= moment + SAME_S) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** The same; before the first of them, the first where it comes at once: a recording begins a moment before its scene. */
function nearest(times: readonly number[], moment: number): number {
  const last = lastUntil(times, moment);
  return last < 0 && (times[0] ?? Infinity) - moment <= FRESH_S ? 0 : last;
}

/** Whether where people and things were is in this record: older ones hold the robot alone. */
export function holdsScene(telemetry: Telemetry): boolean {
  return telemetry.people.time_s.length > 0;
}

/** Where a body other than the robot's was; null where the record does not say. */
function recordedPose(telemetry: Telemetry, body: string, atS: number): readonly number[] | null {
  const person = PERSON.exec(body)?.[1];
  if (person === undefined) {
    const way = telemetry.bodies[body];
    return way === undefined ? null : (way.pose[nearest(way.time_s, atS)] ?? null);
  }
  const { time_s: times, tracks } = telemetry.people;
  const last = nearest(times, atS);
  if (last < 0 || atS - (times[last] ?? 0) > FRESH_S) return null;
  const seen = tracks[last]?.find(([number]) => number === Number(person));
  return seen === undefined ? null : [seen[1], seen[2], HIP_M, 1, 0, 0, 0];
}

/**
 * A row as the 3D view takes it: the robot's bodies where they were, people where the tracker saw them (their limbs at
 * rest), things where they were last put. What the record does not hold is left out, not drawn where it is today.
 * Where the row is not `measured` at the moment that is shown, nothing is left of it but where things stood.
 */
export function frameAt(telemetry: Telemetry, row: number, bodies: readonly string[], gauges: readonly string[], measured = true): PoseFrame | null {
  const posture = postureAt(telemetry, row);
  if (posture === null) return null;
  const known = bodiesOf(posture);
  const atS = at(telemetry, 'time_s', row) ?? 0;
  const poses = new Float32Array(bodies.length * 7).fill(NaN);
  bodies.forEach((name, k) => {
    const robot = known.get(name);
    const pose = robot === undefined ? recordedPose(telemetry, name, atS) : [...robot.at, ...robot.turn];
    if (pose !== null) poses.set(pose, k * 7);
  });
  const values = gauges.map((name) => {
    const value = measured ? at(telemetry, name, row) : null;
    return value === null || (name === 'separation_m' && value > FAR_M) ? NaN : value;
  });
  return { cell: 0, frame: row, tick: 0, atS, poses, gauges: new Float32Array(values) };
}

/** Whether the drawn robot agrees with the measured tool at every row that has both; null where none has. */
export function drawingAgrees(telemetry: Telemetry): boolean | null {
  const rows = telemetry.columns['time_s']?.length ?? 0;
  let checked = 0;
  for (let row = 0; row < rows; row += Math.max(1, Math.floor(rows / 20))) {
    const posture = postureAt(telemetry, row);
    const [x, y, z] = ['tcp_x_m', 'tcp_y_m', 'tcp_z_m'].map((name) => at(telemetry, name, row));
    if (posture === null || x == null || y == null || z == null) continue;
    checked += 1;
    if (toolError(posture.joints, [x, y, z]) > TRUSTED_M) return false;
  }
  return checked === 0 ? null : true;
}

export interface Trace {
  label: string;
  unit: string;
  channel: string;
  /** Another channel that is its limit, and the side of it where things are wrong. */
  limit: string | null;
  /** Top of the scale while the values stay below it: noise fills no plot. */
  span: number;
}

export const TRACES: readonly Trace[] = [
  { label: 'Separation', unit: 'm', channel: 'separation_m', limit: 'protective_separation_m', span: 3 },
  { label: 'Tool speed', unit: 'm/s', channel: 'tcp_speed_mps', limit: null, span: 0.3 },
  { label: 'Base speed', unit: 'm/s', channel: 'base_speed_mps', limit: null, span: 0.4 },
  { label: 'Grip force', unit: 'N', channel: 'grip_force_n', limit: null, span: 25 },
  { label: 'Contact force', unit: 'N', channel: 'contact_force_n', limit: null, span: 25 },
  { label: 'Progress', unit: '', channel: 'progress', limit: null, span: 1 },
  { label: 'Base, by hand', unit: 'm/s', channel: 'hand_base', limit: null, span: 0.3 },
  { label: 'Turn, by hand', unit: 'rad/s', channel: 'hand_turn', limit: null, span: 0.5 },
  { label: 'Tool, by hand', unit: 'm/s', channel: 'hand_tool', limit: null, span: 0.25 },
];

/** What a human asked for is recorded along its axes, and drawn as how fast. */
const ALONG: Readonly<Record<string, readonly string[]>> = {
  hand_base: ['hand_base_x_mps', 'hand_base_y_mps'],
  hand_turn: ['hand_base_yaw_radps'],
  hand_tool: ['hand_tool_x_mps', 'hand_tool_y_mps', 'hand_tool_z_mps'],
};
const COUNTED = 'hand_counts';

/** The traces that this record has something to show in: a hand's where one asked for a motion. */
export function tracesOf(telemetry: Telemetry): Trace[] {
  return TRACES.filter(({ channel }) =>
    entryOf(ALONG, channel) === undefined ? telemetry.columns[channel] !== undefined : valuesOf(telemetry, channel).some((value) => value !== null && value > 0),
  );
}

/** Whether a human asked for a motion at a row that was not made: something was in its way. */
export function unheeded(telemetry: Telemetry, channel: string, row: number): boolean {
  return entryOf(ALONG, channel) !== undefined && (valuesAlong(telemetry, channel)[row] ?? 0) > 0 && at(telemetry, COUNTED, row) === 0;
}

function valuesAlong(telemetry: Telemetry, channel: string): (number | null)[] {
  const [first = [], ...more] = (entryOf(ALONG, channel) ?? []).map((name) => telemetry.columns[name] ?? []);
  return first.map((value, row) => {
    const parts = [value, ...more.map((column) => column[row] ?? null)];
    return parts.some((part) => part === null) ? null : Math.hypot(...parts.map(Number));
  });
}

/** A channel's values for a plot; a distance to nobody is no value. */
export function valuesOf(telemetry: Telemetry, channel: string): (number | null)[] {
  if (entryOf(ALONG, channel) !== undefined) return valuesAlong(telemetry, channel);
  const values = telemetry.columns[channel] ?? [];
  return channel === 'separation_m' ? values.map((value) => (value !== null && value > FAR_M ? null : value)) : values;
}

/** Top of the scale that all of this is drawn in. */
export function topOf({ span }: Trace, ...columns: readonly (readonly (number | null)[])[]): number {
  const most = columns.flat().reduce<number>((top, value) => Math.max(top, value ?? 0), 0);
  return most > span ? 1.1 * most : span;
}

/** What was authorized from a moment on, s: what each channel may reach, by its name. */
export interface Authorized {
  fromS: number;
  bounds: Readonly<Record<string, number>>;
}

/** Such a recovery is the attempt itself, made anew under what it was covered with. */
const ATTEMPTS: ReadonlySet<Json | undefined> = new Set(['RETRY', 'SAFER_MODE']);

/**
 * What was authorized along a trace. Each launch has parameters of its own, as when somebody takes over, and so has each recovery
 * that it covers; the new attempt behind that is under those of the launch again.
 */
export function authorizedAlong(placed: readonly Placed[], inputsOf: (capability: string) => Record<string, InputSchema>): Authorized[] {
  let launched: Authorized['bounds'] = {};
  let anew = launched; // what the next attempt is under
  return placed.flatMap(({ event: { kind, body }, atS }): Authorized[] => {
    const own = boundsIn(body, inputsOf);
    if (kind === 'launch' && !('refused' in body)) {
      launched = anew = own ?? {};
      return [{ fromS: atS, bounds: launched }];
    }
    if (kind === 'recovery') {
      anew = own !== null && ATTEMPTS.has(body['strategy']) ? own : launched;
      return own === null ? [] : [{ fromS: atS, bounds: own }]; // else it moves nothing, or is the attempt that was launched
    }
    return kind === 'status' && body['reason'] === 'new_attempt' ? [{ fromS: atS, bounds: anew }] : [];
  });
}

/** What an event says that something was authorized to; null where it names nothing that moves. */
function boundsIn({ capability, params }: Record<string, Json>, inputsOf: (capability: string) => Record<string, InputSchema>): Authorized['bounds'] | null {
  return typeof capability === 'string' && isParams(params) ? authorizedOf(params, inputsOf(capability)) : null;
}

function isParams(said: Json | undefined): said is Params {
  return typeof said === 'object' && said !== null && !Array.isArray(said);
}

/** What a channel was authorized to reach at a moment; null where nothing bounds it. */
export function boundAt(along: readonly Authorized[], channel: string, atS: number): number | null {
  const now = along.findLast(({ fromS }) => fromS <= atS);
  return now === undefined ? null : (entryOf(now.bounds, channel) ?? null);
}

/** What a channel was authorized to reach, by its name: the parameters say it that fall under a limit of that name. */
export function authorizedOf(params: Params, inputs: Record<string, InputSchema>): Record<string, number> {
  const bounds = Object.entries(params).flatMap(([name, value]) => {
    const channel = entryOf(inputs, name)?.['x-limit'];
    return channel === undefined || typeof value !== 'number' ? [] : [[channel, value] as const];
  });
  return Object.fromEntries(bounds);
}
