import { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
import { MathUtils, PerspectiveCamera, Vector3 } from 'three';
import { tab } from '../state/tab';
import { fitted, framed, heldInSight, outlineOf, seesAll, UNCOVERED, WAIST_M, wholeCell, type Bounds, type Covered, type Scenery } from './framing';

/** What goes on, the whole cell from its corner or from above, or the robot wherever it drives. */
export type View = 'scene' | 'overview' | 'top' | 'follow';

const KEY = 'reins.camera';
/** From where a view looks at the middle of what it shows, of any length. A flat window is filled best from low down. */
const FROM = {
  scene: (aspect: number): Vector3 => new Vector3(-0.36, -0.6, MathUtils.clamp(0.5 / aspect, 0.3, 0.5)),
  overview: (aspect: number): Vector3 => new Vector3(-0.14, -0.62, MathUtils.clamp(0.8 / aspect, 0.38, 0.8)),
  top: (): Vector3 => new Vector3(0, -0.001, 1),
} as const;
/** How soon the camera is where it goes by itself: in this time, ms, it has come so much nearer as e is more than 1. */
const EASE_MS = 160;
const THERE_M = 0.004;
const TURN_RAD = MathUtils.degToRad(5);
const NEARER = 0.9;
/** From where the robot is followed, m. */
const BEHIND = new Vector3(-1.2, -3.6, 2.6);

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
  private chosen: View | null = 'scene';
  private bounds: Bounds | null = null;
  /** What the scene is made of, as the points that have to be seen; nothing before it is known. */
  private outline: readonly Vector3[] = [];
  private covered: Covered = UNCOVERED;
  /** Where the camera goes by itself. */
  private goal: { position: Vector3; target: Vector3 } | null = null;
  private wentMs = 0;
  /** Whether who has hold of the picture has moved it: null while nobody has. */
  private pulled: boolean | null = null;
  /** Where it stood before it was lent to somebody who drives. */
  private lent: Kept | null = null;

  /** `moved` hears when another picture is due, `chose` which view is on: null once somebody has steered. */
  constructor(canvas: HTMLElement, private readonly moved: () => void, private readonly chose: (view: View | null) => void) {
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.maxPolarAngle = MathUtils.degToRad(87);
    this.controls.minDistance = 1;
    this.controls.maxDistance = 60;
    this.controls.addEventListener('change', () => this.changed());
    this.controls.addEventListener('start', () => (this.pulled ??= false)); // once more for each further finger
    this.controls.addEventListener('end', () => this.letGo());
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

  private changed(): void {
    if (this.pulled !== null) this.pulled = true;
    this.moved();
  }

  private letGo(): void {
    const pulled = this.pulled === true;
    this.pulled = null;
    if (pulled) this.steered();
    else this.goOn();
  }

  /** Goes on from here to where it was going: the time for which somebody had hold of the picture is not made up for. */
  private goOn(): void {
    this.wentMs = performance.now();
    this.moved();
  }

  private steered(): void {
    this.goal = null;
    if (this.chosen !== 'follow') this.choose(null);
    this.keep();
  }

  private choose(view: View | null): void {
    this.chosen = view;
    this.chose(view);
  }

  /** Has another cell before it, of these bounds: a view of all of it is fitted to them; the first is framed, unless this tab remembers where its camera stood. */
  frame(bounds: Bounds): void {
    const first = this.bounds === null;
    const kept = first ? read() : null;
    this.bounds = bounds;
    this.outline = [];
    if (this.lent !== null) this.lent = kept ?? this.lent; // for when whoever drives already hands it back
    else if (kept !== null) this.restore(kept);
    else if (first) this.view('scene');
    else if (this.chosen !== 'scene') this.fitAgain(); // what goes on is shown as soon as it is known
  }

  /** Shows all of what goes on, where that is the view that was chosen; it is framed anew where it is something else, or was about to go out of sight. */
  show(scenery: Scenery, anew: boolean): void {
    const first = this.outline.length === 0;
    this.outline = outlineOf(scenery);
    if (this.chosen !== 'scene' || (!anew && !first && this.seen(heldInSight(scenery)))) return;
    if (first) this.fit('scene');
    else this.goToScene();
  }

  /** Where the camera is, or is about to be. */
  private seen(points: readonly Vector3[]): boolean {
    if (this.goal === null) return seesAll(this.camera, points, this.covered);
    const there = this.camera.clone();
    there.position.copy(this.goal.position);
    there.lookAt(this.goal.target);
    return seesAll(there, points, this.covered);
  }

  private goToScene(): void {
    if (matchMedia('(prefers-reduced-motion: reduce)').matches) {
      this.fit('scene');
      return;
    }
    if (this.goal === null) this.wentMs = performance.now();
    this.goal = framed(this.outline, FROM.scene(this.camera.aspect), this.camera, this.covered);
    this.moved();
  }

  /** Goes on to where the camera goes by itself, and says whether it is still on its way. */
  advance(nowMs: number): boolean {
    if (this.goal === null || this.pulled !== null) return false;
    const { position, target } = this.goal;
    const part = 1 - Math.exp(-Math.max(0, nowMs - this.wentMs) / EASE_MS);
    this.wentMs = Math.max(this.wentMs, nowMs);
    const before = this.camera.position.distanceTo(position);
    this.camera.position.lerp(position, part);
    this.controls.target.lerp(target, part);
    this.look();
    const left = this.camera.position.distanceTo(position);
    if (left < THERE_M || (part > 0 && left >= before)) this.goal = null; // as far as it may go
    return this.goal !== null;
  }

  /** Something lies over the picture, or does not any more. */
  cover(covered: Covered): void {
    if (covered.above === this.covered.above && covered.below === this.covered.below) return;
    this.covered = covered;
    if (this.chosen === 'scene' && this.outline.length > 0) this.goToScene();
    else this.fitAgain();
  }

  /** Goes to the robot for as long as somebody drives it, whatever was chosen; then back. What is kept stays as it was. */
  attend(on: boolean, robot: Vector3): void {
    if (on === (this.lent !== null)) return;
    const before = this.lent;
    if (before === null) {
      this.lent = this.stand();
      this.goBehind(robot);
    } else {
      this.lent = null;
      this.restore(before);
    }
  }

  view(view: View, robot?: Vector3): void {
    this.choose(view);
    if (view === 'follow' && robot !== undefined) this.goBehind(robot);
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
    this.look();
  }

  resize(width: number, height: number): void {
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.fitAgain();
    this.moved();
  }

  end(): void {
    this.controls.dispose();
  }

  private fitAgain(): void {
    if (this.chosen !== null && this.chosen !== 'follow') this.fit(this.chosen);
  }

  private fit(view: 'scene' | 'overview' | 'top'): void {
    if (this.bounds === null) return;
    const { aspect, fov } = this.camera;
    const from = FROM[view](aspect);
    const { position, target } =
      view === 'scene' && this.outline.length > 0
        ? framed(this.outline, from, this.camera, this.covered)
        : fitted(wholeCell(this.bounds), from, fov, aspect, this.covered);
    this.put(position, target);
  }

  private put(position: Vector3, target: Vector3): void {
    this.goal = null;
    this.camera.position.copy(position);
    this.controls.target.copy(target);
    this.look();
    this.moved();
  }

  /** Looks at its target from where it was put: that is not the doing of who has hold of the picture. */
  private look(): void {
    const { pulled } = this;
    this.controls.update();
    this.pulled = pulled;
  }

  private goBehind(robot: Vector3): void {
    this.choose('follow');
    this.put(robot.clone().setZ(0).add(BEHIND), new Vector3(robot.x, robot.y, WAIST_M));
  }

  private restore(kept: Kept): void {
    this.choose(kept.view);
    if (kept.view !== null && kept.view !== 'follow') this.fit(kept.view);
    else this.put(new Vector3().fromArray(kept.position), new Vector3().fromArray(kept.target));
  }

  private stand(): Kept {
    return { view: this.chosen, position: this.camera.position.toArray(), target: this.controls.target.toArray() };
  }

  private keep(): void {
    if (this.lent === null) tab.write(KEY, JSON.stringify(this.stand()));
  }
}

function read(): Kept | null {
  try {
    const kept = JSON.parse(tab.read(KEY) ?? 'null') as Kept | null;
    return kept !== null && [...kept.position, ...kept.target].every(Number.isFinite) ? kept : null;
  } catch {
    return null;
  }
}
