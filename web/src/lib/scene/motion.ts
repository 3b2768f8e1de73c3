import type { PoseFrame } from '../socket/frame';

/** What moves less cannot be seen from where the camera stands: metres, and the same of a quaternion. */
export const UNSEEN = 0.0005;

/**
 * Whether there is something to be seen in a frame that was not in the one that was drawn last. Measured against what was
 * drawn, not against the frame before: what creeps is drawn again as soon as it has gone far enough.
 *
 * @param gauges the places of the gauges that are drawn.
 */
export function moved(drawn: PoseFrame | null, frame: PoseFrame, gauges: readonly number[]): boolean {
  if (drawn?.poses.length !== frame.poses.length) return true;
  if (frame.poses.some((value, k) => apart(value, drawn.poses[k] ?? NaN))) return true;
  return gauges.some((k) => apart(frame.gauges[k] ?? NaN, drawn.gauges[k] ?? NaN));
}

function apart(value: number, before: number): boolean {
  return !(Math.abs(value - before) <= UNSEEN) && !Object.is(value, before); // NaN: not known, then as now
}
