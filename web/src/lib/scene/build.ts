import {
  BoxGeometry,
  BufferGeometry,
  CapsuleGeometry,
  CylinderGeometry,
  EdgesGeometry,
  Group,
  LineSegments,
  LineBasicMaterial,
  Matrix4,
  Mesh,
  MeshLambertMaterial,
  SphereGeometry,
  type Color,
} from 'three';
import { mergeGeometries } from 'three/addons/utils/BufferGeometryUtils.js';
import type { Scene, Shape } from '../socket/messages';
import type { Palette } from './palette';

/** The cell's bodies as three.js groups, by name. World axes are the cell's own: x east, y north, z up. */
export interface Bodies {
  root: Group;
  byName: Map<string, Group>;
}

const PERSON = /^person_\d+/;
/** Half a side of a box whose edges are worth a line of their own while it moves, m. */
const LARGE_M = 0.08;

export function isPerson(body: string): boolean {
  return PERSON.test(body);
}

/**
 * Builds every shape of a scene except its floor plane, coloured by the theme: things in grey, people in amber; large boxes with their edges.
 *
 * What moves together and looks alike is one thing to draw: without a graphics card each costs as much as its pixels.
 */
export function buildBodies(scene: Scene, bodies: readonly string[], palette: Palette): Bodies {
  const sorted = new Sorted(scene, bodies, palette);
  for (const shape of scene.shapes) {
    if (shape.shape !== 'plane') sorted.add(shape);
  }
  return sorted.drawn();
}

/** Shapes, in the frame of what they move with and by colour; what never moves is in the frame of the world. */
class Sorted {
  private readonly root = new Group();
  private readonly byName = new Map<string, Group>();
  private readonly fills = new Map<Group, Map<Color, BufferGeometry[]>>();
  private readonly edges = new Map<Group, BufferGeometry[]>();
  private readonly moving: ReadonlySet<string>;

  constructor(private readonly scene: Scene, bodies: readonly string[], private readonly palette: Palette) {
    this.moving = new Set(bodies);
  }

  add(shape: Shape): void {
    const body = this.bodyOf(shape.body);
    const geometry = geometryOf(shape).applyMatrix4(matrixOf(shape.pose));
    const moves = this.moving.has(shape.body);
    const color = colorOf(shape, this.palette, moves);
    const still = this.isStill(shape.body);
    if (still) geometry.applyMatrix4(body.matrix);
    const group = still ? this.root : body;
    if (shape.shape === 'box' && ((still && !moves) || Math.min(...shape.size) >= LARGE_M)) {
      this.edges.set(group, [...(this.edges.get(group) ?? []), new EdgesGeometry(geometry)]);
    }
    this.fill(group, color, geometry);
  }

  drawn(): Bodies {
    for (const [group, alike] of this.fills) {
      for (const [color, geometries] of alike) group.add(new Mesh(joined(geometries), new MeshLambertMaterial({ color })));
    }
    for (const [group, edges] of this.edges) {
      const opacity = group === this.root ? 0.25 : 0.6;
      group.add(new LineSegments(joined(edges), new LineBasicMaterial({ color: this.palette.line, transparent: true, opacity })));
    }
    return { root: this.root, byName: this.byName };
  }

  private isStill(name: string): boolean {
    return name === 'world' || this.scene.fixed[name] !== undefined;
  }

  private bodyOf(name: string): Group {
    const known = this.byName.get(name);
    if (known !== undefined) return known;
    const group = new Group();
    group.name = name;
    const fixed = this.scene.fixed[name];
    if (fixed !== undefined) place(group, fixed);
    group.visible = this.isStill(name); // a moving body is shown from its first pose on
    group.updateMatrix();
    this.byName.set(name, group);
    this.root.add(group);
    return group;
  }

  private fill(group: Group, color: Color, geometry: BufferGeometry): void {
    const alike = this.fills.get(group) ?? new Map<Color, BufferGeometry[]>();
    alike.set(color, [...(alike.get(color) ?? []), geometry]);
    this.fills.set(group, alike);
  }
}

function joined(geometries: BufferGeometry[]): BufferGeometry {
  const whole = mergeGeometries(geometries) as BufferGeometry | null;
  if (whole === null) throw new Error('shapes of one body differ in what their points carry');
  return whole;
}

function matrixOf(pose: ArrayLike<number>): Matrix4 {
  const stand = new Group();
  place(stand, pose);
  stand.updateMatrix();
  return stand.matrix;
}

function geometryOf(shape: Shape): BufferGeometry {
  const [a = 0.05, b = 0.05, c = 0.05] = shape.size;
  switch (shape.shape) {
    case 'box':
      return new BoxGeometry(2 * a, 2 * b, 2 * c);
    case 'sphere':
      return new SphereGeometry(a, 20, 14);
    case 'capsule':
      return new CapsuleGeometry(a, 2 * b, 6, 16).rotateX(Math.PI / 2); // ours stands along z, three's along y
    default:
      return new CylinderGeometry(a, a, 2 * b, 24).rotateX(Math.PI / 2);
  }
}

function colorOf(shape: Shape, palette: Palette, moves: boolean): Color {
  if (isPerson(shape.body)) return palette.person;
  if (!moves) return palette.furniture;
  const [red = 0, green = 0, blue = 0] = shape.rgba;
  // The model paints its robot in near-black and near-white; on either theme that would vanish.
  return red + green + blue < 1.2 ? palette.body : red + green + blue > 2.1 ? palette.light : palette.accent;
}

/** Puts an object at x, y, z, qw, qx, qy, qz. */
export function place(object: { position: { set(x: number, y: number, z: number): unknown }; quaternion: { set(x: number, y: number, z: number, w: number): unknown } }, pose: ArrayLike<number>, at = 0): void {
  object.position.set(pose[at] ?? 0, pose[at + 1] ?? 0, pose[at + 2] ?? 0);
  object.quaternion.set(pose[at + 4] ?? 0, pose[at + 5] ?? 0, pose[at + 6] ?? 0, pose[at + 3] ?? 1);
}

/** Gives the graphics memory of everything below an object back. */
export function dispose(root: Group): void {
  root.traverse((object) => {
    const mesh = object as Partial<Mesh>;
    mesh.geometry?.dispose();
    const material = mesh.material;
    if (Array.isArray(material)) material.forEach((one) => one.dispose());
    else material?.dispose();
  });
  root.clear();
}
