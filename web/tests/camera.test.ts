import { Vector3 } from 'three';
import { afterEach, beforeEach, expect, it, vi } from 'vitest';
import { CameraRig, type View } from '../src/lib/scene/camera';
import type { Scenery } from '../src/lib/scene/framing';
import { tab } from '../src/lib/state/tab';

const ALONE: Scenery = { robot: [1.6, 4.3], reachM: 1.4, people: [], path: [], things: [] };
const VISITED: Scenery = { ...ALONE, people: [[7, 1]] };
let still = false;

class Canvas extends EventTarget {
  readonly style = {};
  readonly ownerDocument = new EventTarget();

  getRootNode(): EventTarget {
    return this.ownerDocument;
  }
}

/** `driven` from before it is known which cell is shown, as where the page was loaded anew. */
function rig(driven = false): { camera: CameraRig; views: (View | null)[]; at: () => Vector3 } {
  const views: (View | null)[] = [];
  const camera = new CameraRig(new Canvas() as unknown as HTMLElement, () => undefined, (view) => views.push(view));
  camera.resize(800, 600);
  if (driven) camera.attend(true, new Vector3());
  camera.frame([0, 0, 8, 6]);
  camera.show(ALONE, true);
  return { camera, views, at: () => camera.camera.position.clone() };
}

/** A finger comes down on the picture, or one more; the last one is lifted. */
const down = ({ controls }: CameraRig): void => controls.dispatchEvent({ type: 'start' });
const up = ({ controls }: CameraRig): void => controls.dispatchEvent({ type: 'end' });

beforeEach(() => {
  still = false;
  tab.drop('reins.camera');
  vi.stubGlobal('matchMedia', () => ({ matches: still }));
  vi.useFakeTimers({ toFake: ['performance'] });
});
afterEach(() => {
  vi.unstubAllGlobals();
  vi.useRealTimers();
});

it('knows a picture that two fingers have moved as steered, however they are lifted', () => {
  const { camera, views } = rig();
  down(camera);
  down(camera);
  camera.controls.dollyIn(0.8);
  down(camera); // of two fingers one is left
  up(camera);
  expect(views.at(-1)).toBeNull();
});

it('goes on from where it stands when somebody lets go who has not moved it', () => {
  const { camera, at } = rig();
  const before = at();
  camera.show(VISITED, true);
  down(camera);
  vi.advanceTimersByTime(3_000);
  expect(camera.advance(performance.now())).toBe(false);
  up(camera);
  vi.advanceTimersByTime(16);
  expect(camera.advance(performance.now())).toBe(true);
  const first = at().distanceTo(before);
  vi.advanceTimersByTime(3_000);
  expect(camera.advance(performance.now())).toBe(false);
  expect(first).toBeLessThan(0.2 * at().distanceTo(before));
});

it('takes a picture that moved by itself under a finger for no steering', () => {
  still = true;
  const { camera, views, at } = rig();
  const before = at();
  down(camera);
  camera.show(VISITED, true);
  up(camera);
  expect(at().distanceTo(before)).toBeGreaterThan(1);
  expect(views.at(-1)).toBe('scene');
});

it('fits the view of a whole cell to each cell that it is shown', () => {
  const { camera, at } = rig();
  camera.view('top');
  const before = at();
  camera.frame([0, 0, 20, 15]);
  expect(at().z).toBeGreaterThan(1.5 * before.z);
});

it('goes back to what was chosen once nobody drives, also where the page was loaded anew meanwhile', () => {
  rig().camera.view('top');
  const { camera, views } = rig(true);
  expect(views.at(-1)).toBe('follow');
  camera.attend(false, new Vector3());
  expect(views.at(-1)).toBe('top');
});
