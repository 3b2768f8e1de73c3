import {
  BoxGeometry,
  BufferGeometry,
  CapsuleGeometry,
  CylinderGeometry,
  EdgesGeometry,
  Group,
  LineSegments,
  LineBasicMaterial,
  Mesh,
  MeshStandardMaterial,
  SphereGeometry,
  type Color,
} from 'three';
import type { Scene, Shape } from '../socket/messages';
import type { Palette } from './palette';

/** The cell's bodies as three.js groups, by name. World axes are the cell's own: x east, y north, z up. */
export interface Bodies {
  root: Group;
  byName: Map<string, Group>;
}

const PERSON = /^person_\d+/;

export function isPerson(body: string): boolean {
  return PERSON.test(body);
}

/** Builds every shape of a scene except its floor plane, coloured by the theme: things in grey, people in amber. */
export function buildBodies(scene: Scene, bodies: readonly string[], palette: Palette): Bodies {
  const root = new Group();
  const byName = new Map<string, Group>();
  const bodyOf = (name: string): Group => {
    let group = byName.get(name);
    if (group === undefined) {
      group = new Group();
      group.name = name;
      const fixed = scene.fixed[name];
      if (fixed !== undefined) place(group, fixed);
      // A moving body is shown from its first pose on.
      else group.visible = name === 'world';
      byName.set(name, group);
      root.add(group);
    }
    return group;
  };
  const moving = new Set(bodies);
  for (const shape of scene.shapes) {
    if (shape.shape === 'plane') continue;
    const mesh = new Mesh(geometryOf(shape), new MeshStandardMaterial({ color: colorOf(shape, palette, moving.has(shape.body)), roughness: 0.85 }));
    place(mesh, shape.pose);
    if (shape.shape === 'box' && !moving.has(shape.body)) mesh.add(edgesOf(mesh.geometry, palette.line));
    bodyOf(shape.body).add(mesh);
  }
  return { root, byName };
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
  if (isPerson(shape.body)) return palette.warn;
  if (!moves) return palette.furniture;
  const [red = 0, green = 0, blue = 0] = shape.rgba;
  // The model paints its robot in near-black and near-white; on either theme that would vanish.
  return red + green + blue < 1.2 ? palette.body : red + green + blue > 2.1 ? palette.light : palette.accent;
}

function edgesOf(geometry: BufferGeometry, color: Color): LineSegments {
  return new LineSegments(new EdgesGeometry(geometry), new LineBasicMaterial({ color, transparent: true, opacity: 0.25 }));
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
