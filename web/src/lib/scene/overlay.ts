import { BufferAttribute, BufferGeometry, DoubleSide, Group, Mesh, MeshBasicMaterial, RingGeometry } from 'three';
import { dispose } from './build';
import type { Palette } from './palette';
import { outline, STEPS, type Gap, type Guard, type Loop, type Spot } from './separation';

/** Half the width of a drawn line on the floor, m: WebGL lines are one pixel thin. */
const HALF_M = 0.022;
const FLOOR_M = 0.014;
const PATH_M = 0.018;
const TIE_M = 0.03;
const DASHES = 64;
const LEAST_M = 0.05;
const UNSEEN_M = 0.002;

/** What is drawn over the cell: the protective separation around the robot, who is within it, the planned path. */
export class Overlay {
  readonly root = new Group();
  private readonly edge: Mesh<BufferGeometry, MeshBasicMaterial>;
  private readonly area: Mesh<BufferGeometry, MeshBasicMaterial>;
  private readonly tie: Mesh<BufferGeometry, MeshBasicMaterial>;
  private readonly path = new Group();
  private drawn: Guard | null = null;

  constructor(private readonly palette: Palette) {
    const rim = 2 * (STEPS + 1);
    this.edge = floorMesh(rim * 6, { color: palette.line });
    this.area = floorMesh(rim * 3, { color: palette.line, depthWrite: false });
    this.tie = floorMesh(DASHES * 6, { color: palette.danger });
    this.root.add(this.edge, this.area, this.tie, this.path);
  }

  /** Draws what has to be kept free around the robot; null where it is not known. */
  separation(guard: Guard | null, violated: boolean): void {
    const shown = guard !== null && guard.neededM > LEAST_M;
    this.edge.visible = this.area.visible = shown;
    if (!shown) return;
    if (this.drawn === null || differs(guard, this.drawn)) {
      const loops = outline(guard);
      fill(this.edge.geometry, loops.flatMap(edging));
      fill(this.area.geometry, loops.flatMap(fan));
      this.drawn = guard;
    }
    const color = violated ? this.palette.danger : this.palette.line;
    this.edge.material.color.copy(color);
    this.edge.material.opacity = violated ? 1 : 0.55;
    this.area.material.color.copy(color);
    this.area.material.opacity = violated ? 0.16 : 0.05;
  }

  /** Ties the robot to the person who is too near, from where that is measured; null where nobody is. */
  tieTo(gap: Gap | null): void {
    this.tie.visible = gap !== null;
    if (gap === null) return;
    const marks = dashes([gap.from, gap.person], 0.08, 0.04).slice(0, DASHES);
    fill(this.tie.geometry, marks.flatMap(([from, to]) => band(from, to, TIE_M)));
  }

  setPath(points: readonly (readonly [number, number])[]): void {
    dispose(this.path);
    if (points.length < 2) return;
    const material = new MeshBasicMaterial({ color: this.palette.accent, side: DoubleSide });
    for (const [from, to] of dashes(points, 0.2, 0.12)) this.path.add(strip(from, to, material));
    const [x, y] = points.at(-1) ?? [0, 0];
    const goal = new Mesh(new RingGeometry(0.07, 0.11, 32), material);
    goal.position.set(x, y, 0.02);
    this.path.add(goal);
  }

  end(): void {
    dispose(this.root);
  }
}

/** A mesh on the floor whose points change; as many as `most`. */
function floorMesh(most: number, look: ConstructorParameters<typeof MeshBasicMaterial>[0]): Mesh<BufferGeometry, MeshBasicMaterial> {
  const geometry = new BufferGeometry().setAttribute('position', new BufferAttribute(new Float32Array(most * 3), 3));
  const mesh = new Mesh(geometry, new MeshBasicMaterial({ ...look, side: DoubleSide, transparent: true }));
  mesh.frustumCulled = false; // its points move
  mesh.visible = false;
  return mesh;
}

/** Puts other triangles into a mesh: they change in every picture while the robot drives. */
function fill(geometry: BufferGeometry, points: readonly number[]): void {
  const position = geometry.getAttribute('position') as BufferAttribute;
  position.array.set(points);
  position.needsUpdate = true;
  geometry.setDrawRange(0, points.length / 3);
}

function differs(one: Guard, other: Guard): boolean {
  const numbers = ({ base, hullM, tool, neededM }: Guard): number[] => [...base, hullM, ...tool, neededM];
  const before = numbers(other);
  return numbers(one).some((value, k) => Math.abs(value - (before[k] ?? NaN)) > UNSEEN_M);
}

/** The line around a loop, as triangles. */
function edging({ rim }: Loop): number[] {
  const beside = ({ at, out }: Loop['rim'][number], asideM: number): Spot => [at[0] + out[0] * asideM, at[1] + out[1] * asideM];
  return pairs(rim).flatMap(([a, b]) => quad([beside(a, HALF_M), beside(a, -HALF_M), beside(b, HALF_M), beside(b, -HALF_M)], FLOOR_M));
}

/** What lies within a loop, as triangles. */
function fan({ centre, rim }: Loop): number[] {
  return pairs(rim).flatMap(([a, b]) => [...centre, FLOOR_M, ...a.at, FLOOR_M, ...b.at, FLOOR_M]);
}

function pairs<T>(row: readonly T[]): [T, T][] {
  return row.slice(1).map((one, k) => [row[k] ?? one, one]);
}

function quad([a, b, c, d]: readonly [Spot, Spot, Spot, Spot], z: number): number[] {
  return [a, b, c, c, b, d].flatMap(([x, y]) => [x, y, z]);
}

/** Cuts a polyline into dashes of a length, m, with gaps between; dashes go round corners. */
export function dashes(points: readonly Spot[], dashM: number, gapM: number): [Spot, Spot][] {
  const found: [Spot, Spot][] = [];
  let on = true;
  let leftM = dashM;
  for (let k = 0; k + 1 < points.length; k += 1) {
    const [ax, ay] = points[k] ?? [0, 0];
    const [bx, by] = points[k + 1] ?? [0, 0];
    const length = Math.hypot(bx - ax, by - ay);
    let done = 0;
    while (done < length - 1e-9) {
      const step = Math.min(leftM, length - done);
      const spot = (at: number): Spot => [ax + ((bx - ax) * at) / length, ay + ((by - ay) * at) / length];
      if (on) found.push([spot(done), spot(done + step)]);
      done += step;
      leftM -= step;
      if (leftM <= 1e-9) {
        on = !on;
        leftM = on ? dashM : gapM;
      }
    }
  }
  return found;
}

/** A straight band of the width of a line, as triangles. */
function band([ax, ay]: Spot, [bx, by]: Spot, z: number): number[] {
  const length = Math.hypot(bx - ax, by - ay);
  const [nx, ny] = length === 0 ? [0, 0] : [((ay - by) / length) * HALF_M, ((bx - ax) / length) * HALF_M];
  return quad([[ax + nx, ay + ny], [ax - nx, ay - ny], [bx + nx, by + ny], [bx - nx, by - ny]], z);
}

function strip(from: Spot, to: Spot, material: MeshBasicMaterial): Mesh {
  const points = new Float32Array(band(from, to, PATH_M));
  return new Mesh(new BufferGeometry().setAttribute('position', new BufferAttribute(points, 3)), material);
}
