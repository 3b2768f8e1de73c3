/**
 * Where the robot's bodies are, from what telemetry keeps of it: the base's pose, six joint angles, the gripper's width.
 *
 * A UR5e by its published DH parameters on the workcell's mobile base, as the simulation builds it. Whether the drawing
 * agrees with what was measured is not taken on trust: see `toolError`.
 */

export type Vector = readonly [number, number, number];
/** w, x, y, z. */
export type Turn = readonly [number, number, number, number];

export interface Pose {
  at: Vector;
  turn: Turn;
}

const DH_A_M = [0, -0.425, -0.3922, 0, 0, 0] as const;
const DH_D_M = [0.1625, 0, 0, 0.1333, 0.0997, 0.0996] as const;
const DH_ALPHA_RAD = [Math.PI / 2, 0, 0, Math.PI / 2, -Math.PI / 2, 0] as const;
const ARM_MOUNT: Pose = { at: [0.12, 0, 0.7], turn: [0, 0, 0, 1] };
export const FLANGE_TO_TCP_M = 0.165;

export const LINKS = ['shoulder_pan_link', 'shoulder_lift_link', 'elbow_link', 'wrist_1_link', 'wrist_2_link', 'wrist_3_link'] as const;
export const GRIPPER = 'gripper';

export interface Posture {
  base: readonly [number, number, number];
  /** Joint angles, rad, in the order of `LINKS`. */
  joints: readonly number[];
  gripWidthM: number;
}

/** Poses in the world of every body of the robot, by the names the scene gives them. */
export function bodiesOf({ base: [x, y, yaw], joints, gripWidthM }: Posture): Map<string, Pose> {
  const found = new Map<string, Pose>();
  const base: Pose = { at: [x, y, 0], turn: aboutZ(yaw) };
  found.set('base', base);
  let parent = within(base, ARM_MOUNT);
  LINKS.forEach((name, k) => {
    const link = within(parent, { at: [0, 0, 0], turn: aboutZ(joints[k] ?? 0) });
    found.set(name, link);
    parent = within(link, { at: [DH_A_M[k] ?? 0, 0, DH_D_M[k] ?? 0], turn: aboutX(DH_ALPHA_RAD[k] ?? 0) });
  });
  found.set(GRIPPER, parent);
  found.set('finger_left', within(parent, { at: [0, gripWidthM / 2, 0], turn: [1, 0, 0, 0] }));
  found.set('finger_right', within(parent, { at: [0, -gripWidthM / 2, 0], turn: [1, 0, 0, 0] }));
  return found;
}

/** Where the tool's centre is, seen from the base, m: what telemetry measures as `tcp_x_m`, `tcp_y_m`, `tcp_z_m`. */
export function toolOf(joints: readonly number[]): Vector {
  const gripper = bodiesOf({ base: [0, 0, 0], joints, gripWidthM: 0 }).get(GRIPPER);
  return gripper === undefined ? [0, 0, 0] : within(gripper, { at: [0, 0, FLANGE_TO_TCP_M], turn: [1, 0, 0, 0] }).at;
}

/** How far, m, the drawn tool is from the measured one. Another robot than a UR5e shows here. */
export function toolError(joints: readonly number[], measured: Vector): number {
  const drawn = toolOf(joints);
  return Math.hypot(drawn[0] - measured[0], drawn[1] - measured[1], drawn[2] - measured[2]);
}

function within(parent: Pose, child: Pose): Pose {
  const [x, y, z] = turned(parent.turn, child.at);
  const [px, py, pz] = parent.at;
  return { at: [px + x, py + y, pz + z], turn: times(parent.turn, child.turn) };
}

function aboutZ(angle: number): Turn {
  return [Math.cos(angle / 2), 0, 0, Math.sin(angle / 2)];
}

function aboutX(angle: number): Turn {
  return [Math.cos(angle / 2), Math.sin(angle / 2), 0, 0];
}

function times([aw, ax, ay, az]: Turn, [bw, bx, by, bz]: Turn): Turn {
  return [
    aw * bw - ax * bx - ay * by - az * bz,
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
  ];
}

function turned([w, x, y, z]: Turn, [vx, vy, vz]: Vector): Vector {
  const [tx, ty, tz] = [2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)];
  return [vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx];
}
