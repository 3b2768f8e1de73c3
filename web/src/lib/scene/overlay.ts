import {
  BufferGeometry,
  CircleGeometry,
  DoubleSide,
  Group,
  Line,
  LineDashedMaterial,
  Mesh,
  MeshBasicMaterial,
  RingGeometry,
  Vector3,
} from 'three';
import { dispose } from './build';
import type { Palette } from './palette';

/** Half the width of a drawn line on the floor, m: WebGL lines are one pixel thin. */
const HALF_M = 0.022;
const SEGMENTS = 96;

/** What is drawn over the cell: the protective separation around the robot, the nearest person, the planned path. */
export class Overlay {
  readonly root = new Group();
  private readonly circle: Mesh<RingGeometry, MeshBasicMaterial>;
  private readonly disc: Mesh<CircleGeometry, MeshBasicMaterial>;
  private readonly tie: Line<BufferGeometry, LineDashedMaterial>;
  private readonly path = new Group();
  private radiusM = 0;

  constructor(private readonly palette: Palette) {
    this.circle = new Mesh(new RingGeometry(0.98, 1, SEGMENTS), new MeshBasicMaterial({ color: palette.line, side: DoubleSide, transparent: true }));
    this.disc = new Mesh(new CircleGeometry(1, 64), new MeshBasicMaterial({ color: palette.line, transparent: true, opacity: 0.06, depthWrite: false }));
    this.tie = new Line(new BufferGeometry().setFromPoints([new Vector3(), new Vector3()]), new LineDashedMaterial({ color: palette.danger, dashSize: 0.08, gapSize: 0.04 }));
    this.circle.frustumCulled = false; // its points move
    this.circle.position.z = this.disc.position.z = 0.014;
    this.circle.visible = this.disc.visible = this.tie.visible = false;
    this.root.add(this.circle, this.disc, this.tie, this.path);
  }

  /** Draws the protective separation, m, around the robot; null where it is not known. */
  separation(robot: { x: number; y: number }, radiusM: number | null, violated: boolean): void {
    const shown = radiusM !== null && radiusM > 0.05;
    this.circle.visible = this.disc.visible = shown;
    if (!shown) return;
    if (Math.abs(radiusM - this.radiusM) > 0.005) {
      widen(this.circle.geometry, radiusM);
      this.disc.scale.setScalar(radiusM);
      this.radiusM = radiusM;
    }
    const color = violated ? this.palette.danger : this.palette.line;
    this.circle.material.color.copy(color);
    this.circle.material.opacity = violated ? 1 : 0.55;
    this.disc.material.color.copy(color);
    this.disc.material.opacity = violated ? 0.16 : 0.05;
    for (const mesh of [this.circle, this.disc]) mesh.position.set(robot.x, robot.y, mesh.position.z);
  }

  /** Ties the robot to the person who is too near; null where nobody is. */
  tieTo(robot: Vector3, person: Vector3 | null): void {
    this.tie.visible = person !== null;
    if (person === null) return;
    this.tie.geometry.setFromPoints([new Vector3(robot.x, robot.y, 0.03), new Vector3(person.x, person.y, 0.03)]);
    this.tie.computeLineDistances();
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

/** Moves the points of a ring to another radius: it changes in every picture while the robot drives. */
function widen(ring: RingGeometry, radiusM: number): void {
  const points = ring.getAttribute('position');
  for (let k = 0; k < points.count; k += 1) {
    const angle = ((k % (SEGMENTS + 1)) / SEGMENTS) * 2 * Math.PI;
    const radius = k <= SEGMENTS ? radiusM - HALF_M : radiusM + HALF_M;
    points.setXY(k, radius * Math.cos(angle), radius * Math.sin(angle));
  }
  points.needsUpdate = true;
}

type Spot = readonly [number, number];

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

function strip([ax, ay]: Spot, [bx, by]: Spot, material: MeshBasicMaterial): Mesh {
  const length = Math.hypot(bx - ax, by - ay);
  const [nx, ny] = length === 0 ? [0, 0] : [((ay - by) / length) * HALF_M, ((bx - ax) / length) * HALF_M];
  const geometry = new BufferGeometry().setFromPoints([
    new Vector3(ax + nx, ay + ny, 0.018), new Vector3(ax - nx, ay - ny, 0.018), new Vector3(bx + nx, by + ny, 0.018),
    new Vector3(bx + nx, by + ny, 0.018), new Vector3(ax - nx, ay - ny, 0.018), new Vector3(bx - nx, by - ny, 0.018),
  ]);
  return new Mesh(geometry, material);
}
