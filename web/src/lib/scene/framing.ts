import { MathUtils, Vector3, type PerspectiveCamera } from 'three';
import type { Spot } from './separation';

/** Of a cell on its ground plane: x0, y0, x1, y1, m. */
export type Bounds = readonly [number, number, number, number];

/** How much of the window's height is covered by what lies over the picture, above and below, 0 to 1. */
export interface Covered {
  above: number;
  below: number;
}

/** What goes on in a cell. */
export interface Scenery {
  robot: Spot;
  /** How far what has to be kept free around the robot reaches, m. */
  reachM: number;
  people: readonly Spot[];
  path: readonly Spot[];
  /** Things that a session is about. */
  things: readonly Vector3[];
}

export const UNCOVERED: Covered = { above: 0, below: 0 };
/** What stands in a cell is about so high, and a person with a name above them, m. */
const TALL_M = 1.3;
/** The middle of a robot, m above the floor. */
export const WAIST_M = 0.5;
const PERSON_M = 2;
const BESIDE_M = 0.4;
const HULL_M = 0.6;
const LEAST_REACH_M = 1.3;
/** Where nothing goes on, more of what the robot stands among is shown. */
const IDLE_REACH_M = 1.9;
const AROUND = 8;
const MARGIN = 0.94;
/** A picture is fitted with so much room around what it shows that a step of somebody does not move the camera. */
const ROOMY = 0.86;

export function wholeCell([x0, y0, x1, y1]: Bounds): Vector3[] {
  return [x0, x1].flatMap((x) => [y0, y1].flatMap((y) => [0, TALL_M].map((z) => new Vector3(x, y, z))));
}

/** The points by which a picture is fitted: all of what goes on, and what the robot stands among. */
export function outlineOf(scenery: Scenery): Vector3[] {
  const { robot, reachM, people, path, things } = scenery;
  const reach = Math.max(reachM, people.length + path.length + things.length === 0 ? IDLE_REACH_M : LEAST_REACH_M);
  return [...around(robot, reach), ...heldInSight(scenery)];
}

/** The points that stay in sight: a picture that shows them is left as it is, or it would move all the time that a robot drives. */
export function heldInSight({ robot, people, path, things }: Scenery): Vector3[] {
  return [
    ...[robot, ...path].flatMap(([x, y]) => [...around([x, y], HULL_M), new Vector3(x, y, TALL_M)]),
    ...people.flatMap(([x, y]) => [-BESIDE_M, BESIDE_M].flatMap((aside) => [new Vector3(x + aside, y, 0), new Vector3(x + aside, y, PERSON_M)])),
    ...things,
  ];
}

function around([x, y]: Spot, radiusM: number): Vector3[] {
  return Array.from({ length: AROUND }, (_, k) => {
    const angle = (k * 2 * Math.PI) / AROUND;
    return new Vector3(x + radiusM * Math.cos(angle), y + radiusM * Math.sin(angle), 0);
  });
}

/** Whether a camera sees all of them where nothing covers the picture. */
export function seesAll(camera: PerspectiveCamera, points: readonly Vector3[], covered: Covered): boolean {
  camera.updateMatrixWorld();
  return points.every((point) => {
    const { x, y, z } = point.clone().project(camera);
    return z < 1 && Math.abs(x) <= 1 && y <= 1 - 2 * covered.above && y >= 2 * covered.below - 1;
  });
}

/** As {@link fitted}, with room around. */
export function framed(points: readonly Vector3[], from: Vector3, camera: PerspectiveCamera, covered: Covered): { position: Vector3; target: Vector3 } {
  return fitted(points, from, camera.fov, camera.aspect, covered, ROOMY);
}

/**
 * Returns from where, and at what, a camera sees all points as large as the uncovered window allows, looking from a direction.
 *
 * With x, y, z a point along the camera's right, up and forward axes, a camera at distance D whose axis is shifted by c sees
 * it where −(D + z)·l ≤ x − c ≤ (D + z)·h, with l and h the slopes of the window's edges: two extremes give the smallest D,
 * and what room is left is shared by both sides.
 */
export function fitted(points: readonly Vector3[], from: Vector3, fovDeg: number, aspect: number, covered = UNCOVERED, margin = MARGIN): { position: Vector3; target: Vector3 } {
  const forward = from.clone().normalize().negate();
  const right = new Vector3().crossVectors(forward, UP).normalize();
  const up = new Vector3().crossVectors(right, forward);
  const centre = points.reduce((sum, point) => sum.add(point), new Vector3()).divideScalar(points.length);
  const seen = points.map((point) => point.clone().sub(centre));
  const tan = Math.tan(MathUtils.degToRad(fovDeg / 2)) * margin;
  const along = (axis: Vector3, low: number, high: number): { far: number; shift: (far: number) => number } => {
    const most = Math.max(...seen.map((point) => point.dot(axis) - point.dot(forward) * high));
    const least = Math.max(...seen.map((point) => -point.dot(axis) - point.dot(forward) * low));
    return { far: (most + least) / (high + low), shift: (far) => (most - far * high + far * low - least) / 2 };
  };
  const across = along(right, tan * aspect, tan * aspect);
  const upright = along(up, tan * (1 - 2 * covered.below), tan * (1 - 2 * covered.above));
  const far = Math.max(across.far, upright.far);
  const target = centre.addScaledVector(right, across.shift(far)).addScaledVector(up, upright.shift(far));
  return { position: target.clone().addScaledVector(forward, -far), target };
}

const UP = new Vector3(0, 0, 1);
