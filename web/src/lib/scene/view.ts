import { Box3, DirectionalLight, Group, HemisphereLight, Scene as World, type Mesh, Vector3, WebGLRenderer } from 'three';
import type { SceneInfo } from '../state/drawn';
import type { PoseFrame } from '../socket/frame';
import { buildBodies, dispose, isPerson, place as put, type Bodies } from './build';
import { CameraRig, type View } from './camera';
import { buildGround, shadow } from './ground';
import { WAIST_M, type Covered } from './framing';
import { Labels, type Label } from './labels';
import { moved } from './motion';
import { Overlay } from './overlay';
import { readPalette, type Palette } from './palette';
import { guardAt, leastGap, MEASURED, type Gap, type Guard, type Spot } from './separation';

const SLOW_MS = 60;
const QUICK_MS = 20;
const LEAST_RATIO = 0.75;
const STUCK_MS = 1_000;
const OUTSIDE_M = 1.5;
const NAMED_FURNITURE = /^(.*)_body$/;
const HEAD_M = 0.28;
const BESIDE_M = 0.62;
const FIGURE_M = 0.3;
const ROBOT_SHADOW_M = 0.5;
const PERSON_SHADOW_M = 0.3;

/** What is wrong at this moment, for highlighting. */
export interface Trouble {
  separation: boolean;
  /** The distance that is too small, as the watcher measured it; null where none is. */
  figure: string | null;
  zones: ReadonlySet<string>;
}

const CALM: Trouble = { separation: false, figure: null, zones: new Set() };

/**
 * One cell in 3D. Draws when something changed and never faster than the screen; poses may come at any rate.
 *
 * Without a graphics card the browser draws in software: multisampling is left out there, and on any machine that cannot
 * keep up the resolution is stepped down before the rate suffers.
 */
export class CellView {
  private readonly renderer: WebGLRenderer;
  private readonly world = new World();
  private readonly rig: CameraRig;
  private readonly labels: Labels;
  private palette: Palette = readPalette();
  private bodies: Bodies = { root: new Group(), byName: new Map() };
  private ground = new Group();
  private overlay = new Overlay(this.palette);
  private info: SceneInfo | null = null;
  private path: readonly [number, number][] = [];
  private subjects: ReadonlySet<string> = new Set();
  private trouble: Trouble = CALM;
  private last: PoseFrame | null = null;
  /** To the person who is too near. */
  private gap: Gap | null = null;
  private guard: Guard | null = null;
  /** What the picture showed last, by name: where that changes, it is framed anew. */
  private shown = '';
  private dirty = true;
  private request = 0;
  private readonly ratio: number;
  private slow = 0;
  private fence: WebGLSync | null = null;
  private fencedMs = 0;
  private readonly robot = new Vector3();
  private readonly shadows = new Map<string, Mesh>();

  /**
   * `lost` hears when the graphics card has dropped the picture: it takes another view to draw again; `chose` hears which
   * view is on, null once somebody has steered.
   */
  constructor(private readonly host: HTMLElement, layer: HTMLElement, private readonly lost: () => void, chose: (view: View | null) => void) {
    const soft = drawnBy() === 'processor';
    this.renderer = new WebGLRenderer({ antialias: !soft, powerPreference: 'high-performance' });
    this.ratio = soft ? 1 : Math.min(devicePixelRatio, 2);
    this.renderer.setPixelRatio(this.ratio);
    this.host.prepend(this.canvas);
    Object.assign(this.canvas, { tabIndex: 0, role: 'application', ariaLabel: 'Camera: arrow keys turn it, + and - go nearer and away' });
    this.canvas.addEventListener('webglcontextlost', this.lost);
    this.rig = new CameraRig(this.renderer.domElement, () => this.draw(), chose);
    this.labels = new Labels(layer);
    const sun = new DirectionalLight('#ffffff', 1.7);
    sun.position.set(-3, -6, 9);
    this.world.add(new HemisphereLight('#ffffff', '#8795a5', 1.5), sun, this.overlay.root);
    this.draw();
  }

  get canvas(): HTMLCanvasElement {
    return this.renderer.domElement;
  }

  setScene(info: SceneInfo): void {
    this.info = info;
    this.last = null;
    this.rebuild();
    this.rig.frame(info.scene.bounds_m);
  }

  setPath(points: readonly [number, number][]): void {
    this.path = points;
    this.overlay.setPath(points);
    this.show();
    this.draw();
  }

  setTrouble(trouble: Trouble): void {
    const zones = [...trouble.zones].join() !== [...this.trouble.zones].join();
    this.trouble = trouble;
    if (zones) this.rebuild();
    // A frame in which nothing moved is not drawn: who comes to a robot that holds would see no colour.
    else if (this.last !== null && this.info !== null) this.drawSeparation(this.last, this.info);
    this.draw();
  }

  /** The theme changed: colours are read anew. */
  repaint(): void {
    this.palette = readPalette();
    this.world.remove(this.overlay.root);
    this.overlay.end();
    this.overlay = new Overlay(this.palette);
    this.world.add(this.overlay.root);
    this.overlay.setPath(this.path);
    this.rebuild();
  }

  apply(frame: PoseFrame): void {
    const info = this.info;
    if (info === null || frame.poses.length !== info.bodies.length * 7) return;
    // A cell that stands is most of a shift: drawing it again and again would only cost power.
    if (!moved(this.last, frame, Object.values(MEASURED).map((name) => info.gauges.indexOf(name)))) return;
    this.place(frame, info);
  }

  private place(frame: PoseFrame, info: SceneInfo): void {
    this.last = frame;
    info.bodies.forEach((name, k) => {
      const body = this.bodies.byName.get(name);
      if (body === undefined) return;
      const seen = isHere(info, frame.poses, k * 7);
      body.visible = seen;
      if (seen) put(body, frame.poses, k * 7);
      this.cast(name, body);
      if (name === 'base') this.robot.copy(body.position);
    });
    this.drawSeparation(frame, info);
    this.rig.follow(this.robot);
    this.show();
    this.draw();
  }

  private cast(name: string, body: Group): void {
    const shadow = this.shadows.get(name);
    if (shadow === undefined) return;
    shadow.visible = body.visible;
    shadow.position.setX(body.position.x).setY(body.position.y);
  }

  /** Names the things a session is about; everything else on the benches goes without a name. */
  setSubjects(names: ReadonlySet<string>): void {
    this.subjects = names;
    this.show();
    this.draw();
  }

  view(view: View): void {
    this.rig.view(view, this.robot);
  }

  /** Goes to the robot and with it, for as long as somebody drives it; then back to where the camera stood. */
  attend(on: boolean): void {
    this.rig.attend(on, this.robot);
  }

  /** Something lies over the picture: what is shown is put where nothing does. */
  cover(covered: Covered): void {
    this.rig.cover(covered);
  }

  resize(width: number, height: number): void {
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height, false);
    this.rig.resize(width, height);
  }

  end(): void {
    cancelAnimationFrame(this.request);
    this.canvas.removeEventListener('webglcontextlost', this.lost);
    this.labels.clear();
    this.rig.end();
    this.overlay.end();
    dispose(this.bodies.root);
    dispose(this.ground);
    this.renderer.dispose();
    this.renderer.domElement.remove();
  }

  private rebuild(): void {
    if (this.info === null) return;
    this.world.remove(this.bodies.root, this.ground);
    dispose(this.bodies.root);
    dispose(this.ground);
    this.world.background = this.palette.background;
    this.bodies = buildBodies(this.info.scene, this.info.bodies, this.palette);
    this.ground = buildGround(this.info.scene, this.palette, this.trouble.zones);
    this.shadows.clear();
    for (const name of this.bodies.byName.keys()) {
      const radiusM = name === 'base' ? ROBOT_SHADOW_M : isTorso(name) ? PERSON_SHADOW_M : 0;
      if (radiusM > 0) this.shadows.set(name, shadow(radiusM, this.palette));
    }
    this.shadows.forEach((cast) => {
      cast.visible = false; // until it is known where what casts it stands
      this.ground.add(cast);
    });
    this.world.add(this.ground, this.bodies.root);
    if (this.last !== null) this.place(this.last, this.info);
    this.draw();
  }

  private drawSeparation(frame: PoseFrame, info: SceneInfo): void {
    const gauge = (name: string): number | null => {
      const value = frame.gauges[info.gauges.indexOf(name)];
      return value === undefined || !Number.isFinite(value) ? null : value;
    };
    const base = this.bodies.byName.get('base');
    const guard = base?.visible === true ? guardAt([base.position.x, base.position.y], yawOf(base), gauge) : null;
    this.gap = guard === null || !this.trouble.separation ? null : leastGap(guard, this.people().map(({ x, y }): Spot => [x, y]));
    this.guard = guard;
    this.overlay.separation(guard, this.trouble.separation);
    this.overlay.tieTo(this.gap);
  }

  /** Has the camera show what goes on. */
  private show(): void {
    if (this.bodies.byName.get('base')?.visible !== true) return;
    const people = this.people().map(({ x, y }): Spot => [x, y]);
    const things = [...this.subjects].flatMap((name) => this.bodies.byName.get(name) ?? []).filter((body) => body.visible);
    const shown = JSON.stringify([this.path, people.length, things.map(({ name }) => name)]);
    const reachM = this.guard === null ? 0 : this.guard.hullM + this.guard.neededM;
    const scenery = { robot: [this.robot.x, this.robot.y] as const, reachM, people, path: this.path, things: things.map(({ position }) => position) };
    this.rig.show(scenery, shown !== this.shown);
    this.shown = shown;
  }

  /** Where people stand, on the floor. */
  private people(): Vector3[] {
    return [...this.bodies.byName]
      .filter(([name, body]) => isTorso(name) && body.visible)
      .map(([, body]) => body.position.clone().setZ(0));
  }

  private labelled(): Map<string, Label> {
    const found = new Map<string, Label>();
    const info = this.info;
    if (info === null) return found;
    for (const [name, body] of this.bodies.byName) this.nameBody(found, name, body);
    // Where there is room for one name, the robot's is worth more than the floor's.
    for (const zone of info.scene.zones) {
      const [x, y] = middle(zone.polygon);
      found.set(`zone ${zone.name}`, { text: zone.name, at: new Vector3(x, y, 0.02), tone: this.trouble.zones.has(zone.name) ? 'danger' : 'plain' });
    }
    if (this.gap !== null && this.trouble.figure !== null) found.set('gap', { text: this.trouble.figure, at: this.beside(this.gap), tone: 'danger', boxed: true, clearOf: this.robot.clone().setZ(WAIST_M) });
    this.people().forEach((at, k) => found.set(`person ${k}`, { text: `person ${k + 1}`, at: at.setZ(1.75 + HEAD_M), tone: 'warn' }));
    return found;
  }

  private nameBody(found: Map<string, Label>, name: string, body: Group): void {
    if (name === 'base' && body.visible) found.set(name, { text: 'robot', at: this.before(body), tone: 'plain' });
    if (this.subjects.has(name) && body.visible) found.set(name, { text: name, at: above(body, 0.12), tone: 'accent' });
    const furniture = NAMED_FURNITURE.exec(name)?.[1];
    if (furniture !== undefined) found.set(name, { text: furniture.replace(/_post$/, ''), at: body.position.clone().setZ(0.42), tone: 'plain' });
  }

  /** A spot on the floor between a body and the camera: a name there covers nothing of it. */
  private before(body: Group): Vector3 {
    const aside = this.rig.camera.position.clone().sub(body.position).setZ(0).setLength(BESIDE_M);
    return body.position.clone().setZ(0).add(aside);
  }

  /** A spot beside the middle of the line that ties somebody to the robot, on the camera's side of it. */
  private beside({ from, person }: Gap): Vector3 {
    const middle = new Vector3((from[0] + person[0]) / 2, (from[1] + person[1]) / 2, 0);
    const aside = new Vector3(from[1] - person[1], person[0] - from[0], 0).setLength(FIGURE_M);
    const away = this.rig.camera.position.clone().sub(middle).dot(aside) < 0;
    return middle.add(away ? aside.negate() : aside);
  }

  /** Something changed: another picture is due. */
  private draw(): void {
    this.dirty = true;
    this.ask();
  }

  /** Wants the screen's next turn. Nobody asks while nothing changes: turns that draw nothing would only cost power. */
  private ask(): void {
    if (this.request === 0) this.request = requestAnimationFrame(this.loop);
  }

  private readonly loop = (now: number): void => {
    this.request = 0;
    if (this.drawn(now)) {
      if (!this.dirty) return;
      this.paint(now);
    }
    this.ask(); // at least until the picture is really drawn
  };

  private paint(now: number): void {
    this.dirty = this.rig.advance(now);
    const { clientWidth: width, clientHeight: height } = this.host;
    this.renderer.render(this.world, this.rig.camera);
    this.labels.draw(this.labelled(), this.rig.camera, width, height);
    const gl = this.renderer.getContext() as WebGL2RenderingContext;
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.fencedMs = now;
    gl.flush();
  }

  /** One picture at a time: another is begun when the last is really drawn, or frames would queue up and age. */
  private drawn(now: number): boolean {
    if (this.fence === null) return true;
    const gl = this.renderer.getContext() as WebGL2RenderingContext;
    if (gl.getSyncParameter(this.fence, gl.SYNC_STATUS) !== gl.SIGNALED && now - this.fencedMs < STUCK_MS) return false;
    gl.deleteSync(this.fence);
    this.fence = null;
    this.keepUp(now - this.fencedMs);
    return true;
  }

  private keepUp(tookMs: number): void {
    const ratio = this.renderer.getPixelRatio();
    this.slow = tookMs > SLOW_MS ? Math.max(0, this.slow) + 1 : tookMs < QUICK_MS ? Math.min(0, this.slow) - 1 : 0;
    const wanted = this.slow > 20 ? Math.max(LEAST_RATIO, ratio * 0.85) : this.slow < -200 ? Math.min(this.ratio, ratio / 0.85) : ratio;
    if (wanted === ratio) return;
    this.slow = 0;
    this.renderer.setPixelRatio(wanted); // the window is as large as it was: the camera stays where it is
    this.draw();
  }
}

/** What is not in the cell (people before they come, obstacles not yet put) waits far outside or under the floor. */
function isHere(info: SceneInfo, poses: Float32Array, at: number): boolean {
  const [x0, y0, x1, y1] = info.scene.bounds_m;
  const [x = NaN, y = NaN, z = NaN] = poses.subarray(at, at + 3);
  return x > x0 - OUTSIDE_M && x < x1 + OUTSIDE_M && y > y0 - OUTSIDE_M && y < y1 + OUTSIDE_M && z > -0.5;
}

function isTorso(name: string): boolean {
  return isPerson(name) && name.endsWith('_torso');
}

function yawOf({ quaternion: { z, w } }: Group): number {
  return 2 * Math.atan2(z, w);
}

function middle(polygon: readonly (readonly [number, number])[]): [number, number] {
  const mean = (axis: 0 | 1): number => polygon.reduce((sum, point) => sum + point[axis], 0) / polygon.length;
  return [mean(0), mean(1)];
}

function above(body: Group, clearM: number): Vector3 {
  const box = new Box3().setFromObject(body);
  return body.position.clone().setZ((box.isEmpty() ? body.position.z : box.max.z) + clearM); // what never moves is drawn as one
}

/** Who draws WebGL here; throws where nobody does, before three.js complains of that on the console. */
function drawnBy(): 'card' | 'processor' {
  const gl = document.createElement('canvas').getContext('webgl2');
  if (gl === null) throw new Error('this browser has no WebGL 2');
  const info = gl.getExtension('WEBGL_debug_renderer_info');
  const name = info === null ? '' : String(gl.getParameter(info.UNMASKED_RENDERER_WEBGL));
  gl.getExtension('WEBGL_lose_context')?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name) ? 'processor' : 'card';
}
