import { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
import { MathUtils, PerspectiveCamera, Vector3 } from 'three';
import { tab } from '../state/tab';

export type View = 'overview' | 'top' | 'follow';
type Bounds = readonly [number, number, number, number];

const KEY = 'reins.camera';
/** From where a view looks at the middle of the cell, of any length. A flat window is filled best from low down. */
const FROM = {
  overview: (aspect: number): Vector3 => new Vector3(-0.14, -0.62, MathUtils.clamp(0.8 / aspect, 0.38, 0.8)),
  top: (): Vector3 => new Vector3(0, -0.001, 1),
} as const;
/** What stands in a cell is about so high, m. */
const TALL_M = 1.3;
const MARGIN = 0.94;
const TURN_RAD = MathUtils.degToRad(5);
const NEARER = 0.9;
/** From where the robot is followed, and at which height it is looked at, m. */
const BEHIND = new Vector3(-1.2, -3.6, 2.6);
const WAIST_M = 0.5;

interface Kept {
  /** The view that was chosen, if nobody has steered since: it is fitted anew to whatever window there is. */
  view: View | null;
  position: number[];
  target: number[];
}

/** The camera and how it is steered; where it stands is kept across reloads of this tab. */
export class CameraRig {
  readonly camera = new PerspectiveCamera(38, 1, 0.1, 80);
  readonly controls: OrbitControls;
  private chosen: View | null = 'overview';
  private bounds: Bounds = [0, 0, 8, 6];
  /** Where it stood before it was lent to somebody who drives. */
  private lent: Kept | null = null;

  constructor(canvas: HTMLElement, private readonly moved: () => void) {
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.maxPolarAngle = MathUtils.degToRad(87);
    this.controls.minDistance = 1;
    this.controls.maxDistance = 30;
    this.controls.addEventListener('change', moved);
    this.controls.addEventListener('end', () => this.steered());
    canvas.addEventListener('keydown', (event) => this.press(event));
    // Who pulls at it with the mouse has not gone there: arrows go on stepping through a record.
    canvas.addEventListener('focus', () => canvas.matches(':focus-visible') || canvas.blur());
  }

  /** Steers by a key that is pressed on the picture; while somebody drives, keys are the robot's. */
  private press(event: KeyboardEvent): void {
    const { controls } = this;
    const steer = {
      ArrowLeft: () => controls.rotateLeft(TURN_RAD),
      ArrowRight: () => controls.rotateLeft(-TURN_RAD),
      ArrowUp: () => controls.rotateUp(TURN_RAD),
      ArrowDown: () => controls.rotateUp(-TURN_RAD),
      '+': () => controls.dollyIn(NEARER),
      '-': () => controls.dollyOut(NEARER),
    }[event.key];
    if (steer === undefined || this.lent !== null || event.altKey || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    steer();
    this.steered();
  }

  private steered(): void {
    if (this.chosen !== 'follow') this.chosen = null;
    this.keep();
  }

  /** Frames a cell of these bounds, unless this tab remembers where its camera stood. */
  frame(bounds: Bounds): void {
    this.bounds = bounds;
    if (this.lent !== null) return;
    const kept = read();
    if (kept === null) this.view('overview');
    else this.restore(kept);
  }

  /** Goes to the robot for as long as somebody drives it, whatever was chosen; then back. What is kept stays as it was. */
  attend(on: boolean, robot: Vector3): void {
    if (on === (this.lent !== null)) return;
    const before = this.lent;
    if (before === null) {
      this.lent = this.stand();
      this.goTo(robot);
    } else {
      this.lent = null;
      this.restore(before);
    }
  }

  view(view: View, robot?: Vector3): void {
    this.chosen = view;
    if (view === 'follow' && robot !== undefined) this.goTo(robot);
    else if (view !== 'follow') this.fit(view);
    this.keep();
  }

  /** Moves with the robot while that view is chosen. */
  follow(robot: Vector3): void {
    if (this.chosen !== 'follow') return;
    const shift = new Vector3(robot.x, robot.y, WAIST_M).sub(this.controls.target);
    if (shift.lengthSq() < 1e-5) return;
    this.camera.position.add(shift);
    this.controls.target.add(shift);
    this.controls.update();
  }

  resize(width: number, height: number): void {
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.chosen === 'overview' || this.chosen === 'top') this.fit(this.chosen);
    this.moved();
  }

  end(): void {
    this.controls.dispose();
  }

  private fit(view: 'overview' | 'top'): void {
    const { aspect, fov } = this.camera;
    const { position, target } = fitted(this.bounds, FROM[view](aspect), fov, aspect);
    this.put(position, target);
  }

  private put(position: Vector3, target: Vector3): void {
    this.camera.position.copy(position);
    this.controls.target.copy(target);
    this.controls.update();
    this.moved();
  }

  private goTo(robot: Vector3): void {
    this.chosen = 'follow';
    this.put(robot.clone().setZ(0).add(BEHIND), new Vector3(robot.x, robot.y, WAIST_M));
  }

  private restore(kept: Kept): void {
    this.chosen = kept.view;
    if (kept.view === 'overview' || kept.view === 'top') this.fit(kept.view);
    else this.put(new Vector3().fromArray(kept.position), new Vector3().fromArray(kept.target));
  }

  private stand(): Kept {
    return { view: this.chosen, position: this.camera.position.toArray(), target: this.controls.target.toArray() };
  }

  private keep(): void {
    if (this.lent === null) tab.write(KEY, JSON.stringify(this.stand()));
  }
}

/**
 * Returns from where, and at what, a camera sees the whole cell as large as the window allows, looking from a direction.
 *
 * With x, y, z the corners along the camera's right, up and forward axes, a camera at distance D whose axis is shifted by c
 * sees a corner where |x − c| ≤ (D + z)·tan(half the field of view): two extremes give the smallest D and the c between.
 */
export function fitted(bounds: Bounds, from: Vector3, fovDeg: number, aspect: number): { position: Vector3; target: Vector3 } {
  const [x0, y0, x1, y1] = bounds;
  const centre = new Vector3((x0 + x1) / 2, (y0 + y1) / 2, TALL_M / 2);
  const forward = from.clone().normalize().negate();
  const right = new Vector3().crossVectors(forward, new Vector3(0, 0, 1)).normalize();
  const up = new Vector3().crossVectors(right, forward);
  const corners = [x0, x1].flatMap((x) => [y0, y1].flatMap((y) => [0, TALL_M].map((z) => new Vector3(x, y, z).sub(centre))));
  const tan = Math.tan(MathUtils.degToRad(fovDeg / 2)) * MARGIN;
  const along = (axis: Vector3, slope: number): { far: number; shift: number } => {
    const high = Math.max(...corners.map((corner) => corner.dot(axis) - corner.dot(forward) * slope));
    const low = Math.max(...corners.map((corner) => -corner.dot(axis) - corner.dot(forward) * slope));
    return { far: (high + low) / (2 * slope), shift: (high - low) / 2 };
  };
  const [across, upright] = [along(right, tan * aspect), along(up, tan)];
  const target = centre.addScaledVector(right, across.shift).addScaledVector(up, upright.shift);
  return { position: target.clone().addScaledVector(forward, -Math.max(across.far, upright.far)), target };
}

function read(): Kept | null {
  try {
    const kept = JSON.parse(tab.read(KEY) ?? 'null') as Kept | null;
    return kept !== null && [...kept.position, ...kept.target].every(Number.isFinite) ? kept : null;
  } catch {
    return null;
  }
}
