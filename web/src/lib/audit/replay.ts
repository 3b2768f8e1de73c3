import type { Telemetry } from '../api/documents';
import type { PoseFrame } from '../socket/frame';
import { bodiesOf, toolError, type Posture } from './kinematics';

const FAR_M = 90;
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

/**
 * A row as the 3D view takes it: the robot's bodies where they were, everything else that moves not known.
 *
 * Objects and people are not part of telemetry. They are left out rather than drawn where they are today.
 */
export function frameAt(telemetry: Telemetry, row: number, bodies: readonly string[], gauges: readonly string[]): PoseFrame | null {
  const posture = postureAt(telemetry, row);
  if (posture === null) return null;
  const known = bodiesOf(posture);
  const poses = new Float32Array(bodies.length * 7).fill(NaN);
  bodies.forEach((name, k) => {
    const pose = known.get(name);
    if (pose !== undefined) poses.set([...pose.at, ...pose.turn], k * 7);
  });
  const values = gauges.map((name) => {
    const value = at(telemetry, name, row);
    return value === null || (name === 'separation_m' && value > FAR_M) ? NaN : value;
  });
  return { cell: 0, frame: row, tick: 0, atS: at(telemetry, 'time_s', row) ?? 0, poses, gauges: new Float32Array(values) };
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
}

export const TRACES: readonly Trace[] = [
  { label: 'Separation', unit: 'm', channel: 'separation_m', limit: 'protective_separation_m' },
  { label: 'Tool speed', unit: 'm/s', channel: 'tcp_speed_mps', limit: null },
  { label: 'Base speed', unit: 'm/s', channel: 'base_speed_mps', limit: null },
  { label: 'Grip force', unit: 'N', channel: 'grip_force_n', limit: null },
  { label: 'Contact force', unit: 'N', channel: 'contact_force_n', limit: null },
  { label: 'Progress', unit: '', channel: 'progress', limit: null },
];

/** A channel's values for a plot; a distance to nobody is no value. */
export function valuesOf(telemetry: Telemetry, channel: string): (number | null)[] {
  const values = telemetry.columns[channel] ?? [];
  return channel === 'separation_m' ? values.map((value) => (value !== null && value > FAR_M ? null : value)) : values;
}
