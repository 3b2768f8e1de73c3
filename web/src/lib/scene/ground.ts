import {
  BufferGeometry,
  DoubleSide,
  Float32BufferAttribute,
  Group,
  Line,
  LineBasicMaterial,
  LineDashedMaterial,
  LineLoop,
  LineSegments,
  Mesh,
  MeshBasicMaterial,
  Shape,
  ShapeGeometry,
  Vector2,
  Vector3,
} from 'three';
import type { Scene, ZoneShape } from '../socket/messages';
import type { Palette } from './palette';

const HATCH_M = 0.14;
const SHADOW_STEPS = 40;

/** The floor with its grid, and the zones painted on it: forbidden hatched, restricted and shared outlined. */
export function buildGround(scene: Scene, palette: Palette, violated: ReadonlySet<string>): Group {
  const ground = new Group();
  const [x0, y0, x1, y1] = scene.bounds_m;
  ground.add(filled([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], palette.floor, 1, -0.004), grid(scene.bounds_m, palette));
  for (const zone of scene.zones) ground.add(zoneOf(zone, palette, violated.has(zone.name)));
  return ground;
}

/** What something casts that stands on the floor, as if lit from straight above: without it things seem to float. */
export function shadow(radiusM: number, palette: Palette): Mesh {
  const rim = Array.from({ length: SHADOW_STEPS }, (_, k): [number, number] => {
    const angle = (k * 2 * Math.PI) / SHADOW_STEPS;
    return [radiusM * Math.cos(angle), radiusM * Math.sin(angle)];
  });
  return filled(rim, palette.shade, 0.22, 0.006);
}

function grid([x0, y0, x1, y1]: Scene['bounds_m'], palette: Palette): LineSegments {
  const points: number[] = [];
  for (let x = Math.ceil(x0); x <= x1; x += 1) points.push(x, y0, 0, x, y1, 0);
  for (let y = Math.ceil(y0); y <= y1; y += 1) points.push(x0, y, 0, x1, y, 0);
  return new LineSegments(positions(points), new LineBasicMaterial({ color: palette.grid }));
}

function zoneOf(zone: ZoneShape, palette: Palette, violated: boolean): Group {
  const group = new Group();
  const color = violated ? palette.danger : palette.line;
  const forbidden = zone.kind === 'forbidden';
  group.add(filled(zone.polygon, color, violated ? 0.28 : forbidden ? 0.05 : 0.09, 0.004));
  const edge = zone.polygon.map(([x, y]) => new Vector3(x, y, 0.01));
  if (forbidden || violated) {
    group.add(new LineLoop(new BufferGeometry().setFromPoints(edge), new LineBasicMaterial({ color })));
    group.add(new LineSegments(positions(hatch(zone.polygon)), new LineBasicMaterial({ color, transparent: true, opacity: 0.6 })));
  } else {
    const first = edge[0];
    const closed = first === undefined ? edge : [...edge, first];
    const dashed = new Line(
      new BufferGeometry().setFromPoints(closed),
      new LineDashedMaterial({ color, dashSize: 0.06, gapSize: 0.06 }),
    );
    dashed.computeLineDistances();
    group.add(dashed);
  }
  return group;
}

function filled(polygon: readonly (readonly [number, number])[], color: Palette['line'], opacity: number, z: number): Mesh {
  const shape = new Shape(polygon.map(([x, y]) => new Vector2(x, y)));
  const mesh = new Mesh(
    new ShapeGeometry(shape),
    new MeshBasicMaterial({ color, transparent: opacity < 1, opacity, side: DoubleSide, depthWrite: opacity >= 1 }),
  );
  mesh.position.z = z;
  return mesh;
}

/** Diagonal lines clipped to a polygon. Each is where x + y is constant; edges are met pairwise. */
export function hatch(polygon: readonly (readonly [number, number])[]): number[] {
  const sums = polygon.map(([x, y]) => x + y);
  const points: number[] = [];
  const first = Math.ceil(Math.min(...sums) / HATCH_M) * HATCH_M;
  for (let sum = first; sum < Math.max(...sums); sum += HATCH_M) {
    const cuts = crossings(polygon, sum).sort((a, b) => a[0] - b[0]);
    for (let k = 0; k + 1 < cuts.length; k += 2) {
      const [from, to] = [cuts[k], cuts[k + 1]];
      if (from !== undefined && to !== undefined) points.push(from[0], from[1], 0.008, to[0], to[1], 0.008);
    }
  }
  return points;
}

function crossings(polygon: readonly (readonly [number, number])[], sum: number): [number, number][] {
  const found: [number, number][] = [];
  polygon.forEach(([ax, ay], k) => {
    const [bx, by] = polygon[(k + 1) % polygon.length] ?? [ax, ay];
    const [a, b] = [ax + ay - sum, bx + by - sum];
    if (a < 0 === b < 0) return;
    const t = a / (a - b);
    found.push([ax + t * (bx - ax), ay + t * (by - ay)]);
  });
  return found;
}

function positions(points: readonly number[]): BufferGeometry {
  return new BufferGeometry().setAttribute('position', new Float32BufferAttribute(points, 3));
}
