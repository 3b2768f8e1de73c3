import { PerspectiveCamera, Vector3 } from 'three';
import { within } from '../src/lib/scene/labels';
import { describe, expect, it } from 'vitest';
import { fitted } from '../src/lib/scene/camera';

const BOUNDS = [0, 0, 8, 6] as const;

function extent(from: Vector3, aspect: number): { x: number; y: number } {
  const camera = new PerspectiveCamera(38, aspect, 0.1, 80);
  camera.up.set(0, 0, 1);
  const { position, target } = fitted(BOUNDS, from, 38, aspect);
  camera.position.copy(position);
  camera.lookAt(target);
  camera.updateMatrixWorld();
  const seen = [0, 8].flatMap((x) => [0, 6].flatMap((y) => [0, 1.3].map((z) => new Vector3(x, y, z).project(camera))));
  return { x: Math.max(...seen.map((point) => Math.abs(point.x))), y: Math.max(...seen.map((point) => Math.abs(point.y))) };
}

describe('the camera that shows a whole cell', () => {
  for (const aspect of [0.6, 0.94, 2.1]) {
    for (const [name, from] of Object.entries({ corner: new Vector3(-0.24, -0.64, 0.52), top: new Vector3(0, -0.001, 1) })) {
      it(`cuts nothing off and comes as near as it may, from the ${name} at ${aspect}`, () => {
        const { x, y } = extent(from, aspect);
        expect(Math.max(x, y)).toBeCloseTo(0.94, 2);
        expect(Math.min(x, y)).toBeLessThanOrEqual(0.945);
      });
    }
  }
});

describe('a name in the scene', () => {
  it('is moved in from the edge, and is none where its point is out of sight', () => {
    expect([within(2, 20, 110), within(100, 20, 110), within(50, 20, 110), within(50, 80, 110)]).toEqual([20, 90, 50, 55]);
    expect([within(-1, 20, 110), within(111, 20, 110)]).toEqual([null, null]);
  });
});
