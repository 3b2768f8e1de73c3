import { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
import { MathUtils, PerspectiveCamera, Vector3 } from 'three';

export type View = 'overview' | 'top' | 'follow';

const KEY = 'reins.camera';

interface Kept {
  position: number[];
  target: number[];
}

/** The camera and how it is steered; where it stands is kept across reloads of this tab. */
export class CameraRig {
  readonly camera = new PerspectiveCamera(38, 1, 0.1, 80);
  readonly controls: OrbitControls;
  private following = false;
  private centre = new Vector3(4, 3, 0);
  private spanM = 8;

  constructor(canvas: HTMLElement, private readonly moved: () => void) {
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.maxPolarAngle = MathUtils.degToRad(87);
    this.controls.minDistance = 1;
    this.controls.maxDistance = 30;
    this.controls.addEventListener('change', moved);
    this.controls.addEventListener('end', () => this.keep());
  }

  /** Frames a cell of these bounds, unless this tab remembers where its camera stood. */
  frame([x0, y0, x1, y1]: readonly [number, number, number, number]): void {
    this.centre = new Vector3((x0 + x1) / 2, (y0 + y1) / 2, 0.2);
    this.spanM = Math.max(x1 - x0, y1 - y0);
    const kept = read();
    if (kept === null) this.view('overview');
    else this.put(new Vector3().fromArray(kept.position), new Vector3().fromArray(kept.target));
  }

  view(view: View, robot?: Vector3): void {
    this.following = view === 'follow';
    const { x, y } = this.centre;
    const half = Math.tan(MathUtils.degToRad(this.camera.fov / 2)) * Math.min(this.camera.aspect, 1.35);
    const far = (0.56 * this.spanM) / half;
    if (view === 'top') this.put(new Vector3(x, y - 0.01, far * 1.05), new Vector3(x, y, 0));
    else if (view === 'follow' && robot !== undefined) this.put(new Vector3(robot.x - 1.2, robot.y - 3.6, 2.6), new Vector3(robot.x, robot.y, 0.5));
    else this.put(new Vector3(x - far * 0.24, y - far * 0.64, far * 0.52), this.centre);
    this.keep();
  }

  /** Moves with the robot while that view is chosen. */
  follow(robot: Vector3): void {
    if (!this.following) return;
    const shift = new Vector3(robot.x, robot.y, 0.5).sub(this.controls.target);
    if (shift.lengthSq() < 1e-5) return;
    this.camera.position.add(shift);
    this.controls.target.add(shift);
    this.controls.update();
  }

  resize(width: number, height: number): void {
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.moved();
  }

  end(): void {
    this.controls.dispose();
  }

  private put(position: Vector3, target: Vector3): void {
    this.camera.position.copy(position);
    this.controls.target.copy(target);
    this.controls.update();
    this.moved();
  }

  private keep(): void {
    const kept: Kept = { position: this.camera.position.toArray(), target: this.controls.target.toArray() };
    sessionStorage.setItem(KEY, JSON.stringify(kept));
  }
}

function read(): Kept | null {
  try {
    const kept = JSON.parse(sessionStorage.getItem(KEY) ?? 'null') as Kept | null;
    return kept !== null && [...kept.position, ...kept.target].every(Number.isFinite) ? kept : null;
  } catch {
    return null;
  }
}
