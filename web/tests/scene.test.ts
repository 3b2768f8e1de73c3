import { PerspectiveCamera, Vector3 } from 'three';
import { clear, hides, within } from '../src/lib/scene/labels';
import { describe, expect, it } from 'vitest';
import { fitted, framed, heldInSight, outlineOf, seesAll, wholeCell, type Covered, type Scenery } from '../src/lib/scene/framing';
import { gapTo, guardAt, leastGap, outline, type Guard, type Spot } from '../src/lib/scene/separation';

const BOUNDS = [0, 0, 8, 6] as const;

function extent(from: Vector3, aspect: number): { x: number; y: number } {
  const camera = new PerspectiveCamera(38, aspect, 0.1, 80);
  camera.up.set(0, 0, 1);
  const { position, target } = fitted(wholeCell(BOUNDS), from, 38, aspect);
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

describe('the camera that shows what goes on', () => {
  const ALONE: Scenery = { robot: [1.6, 4.3], reachM: 1.4, people: [], path: [], things: [] };
  const BUSY: Scenery = { ...ALONE, people: [[2.7, 3.5], [7.4, 0.9]], path: [[1.6, 4.3], [5, 3.2]], things: [new Vector3(1.4, 5.1, 0.8)] };

  function looking(scenery: Scenery, aspect: number, covered: Covered): PerspectiveCamera {
    const camera = new PerspectiveCamera(38, aspect, 0.1, 80);
    camera.up.set(0, 0, 1);
    const { position, target } = framed(outlineOf(scenery), new Vector3(-0.36, -0.6, 0.4), camera, covered);
    camera.position.copy(position);
    camera.lookAt(target);
    return camera;
  }

  it.each([0.6, 0.94, 2.6])('sees the robot, everybody, the path and the thing, clear of what lies over the picture (%d)', (aspect) => {
    for (const covered of [{ above: 0, below: 0 }, { above: 0.1, below: 0.12 }, { above: 0, below: 0.3 }]) {
      expect(seesAll(looking(BUSY, aspect, covered), outlineOf(BUSY), covered)).toBe(true);
    }
  });

  it('needs not move for a step of somebody, and has to for somebody who comes from elsewhere', () => {
    const covered = { above: 0.1, below: 0.12 };
    const camera = looking({ ...ALONE, people: [[4.2, 4]] }, 0.94, covered);
    const standing = (at: Spot): boolean => seesAll(camera, heldInSight({ ...ALONE, people: [at] }), covered);
    expect([standing([4.2, 4]), standing([4.4, 4]), standing([4.1, 4.2]), standing([6, 4.3])]).toEqual([true, true, true, false]);
  });

  it('needs not move while the robot drives where it was to go', () => {
    const covered = { above: 0.1, below: 0.12 };
    const driving = { ...ALONE, path: [[1.6, 4.3], [1.6, 3.4], [5, 3.4]] as const };
    const camera = looking(driving, 0.94, covered);
    const at = (...robot: Spot): boolean => seesAll(camera, heldInSight({ ...driving, robot }), covered);
    expect([at(1.6, 3.4), at(3, 3.4), at(5, 3.4), at(7.5, 3.4)]).toEqual([true, true, true, false]);
  });

  it('is nearer where less goes on, but leaves what the robot stands among in sight', () => {
    const far = (scenery: Scenery): number => looking(scenery, 0.94, { above: 0, below: 0 }).position.distanceTo(new Vector3(1.6, 4.3, 0));
    const near = far({ ...ALONE, path: [[1.6, 4.3], [1.8, 4.3]] });
    expect(near).toBeLessThan(far(ALONE));
    expect(far(ALONE)).toBeLessThan(far(BUSY));
  });
});

describe('a name in the scene', () => {
  it('stands clear of another by a space, or on another line', () => {
    const [name, below, beside, touching] = [{ x: 50, y: 50, half: 20 }, { x: 60, y: 66, half: 20 }, { x: 99, y: 52, half: 20 }, { x: 92, y: 52, half: 20 }];
    expect([below, beside, touching].map((other) => clear(name, other))).toEqual([true, true, false]);
  });

  it('hides what a box would lie over, and nothing beside it', () => {
    const figure = { x: 217, y: 203, half: 32 };
    expect([{ x: 200, y: 192 }, { x: 260, y: 203 }, { x: 217, y: 160 }].map((robot) => hides(figure, robot))).toEqual([true, false, false]);
  });

  it('is moved in from the edge, and is none where its point is out of sight', () => {
    expect([within(2, 20, 110), within(100, 20, 110), within(50, 20, 110), within(50, 80, 110)]).toEqual([20, 90, 50, 55]);
    expect([within(-1, 20, 110), within(111, 20, 110)]).toEqual([null, null]);
  });
});

describe('the protective separation', () => {
  const around = (tool: Spot, neededM = 0.8): Guard => ({ base: [2, 3], hullM: 0.45, tool, neededM });
  /** Drawn around the arm folded, over the hull, stretched out, and so far that two circles are apart. */
  const guards = [around([2.1, 3]), around([2.4, 3.3]), around([2.9, 3.2]), around([1.1, 2.2], 0.3), around([2, 4.6], 0.5)];

  it.each(guards)('is drawn where the watcher’s gap is what it has to be (%j)', (guard) => {
    const gaps = outline(guard).flatMap(({ rim }) => rim.map(({ at }) => gapTo(guard, at).gapM - guard.neededM));
    expect(Math.max(...gaps.map(Math.abs))).toBeLessThan(1e-9);
  });

  it.each(guards)('leaves nobody out who is nearer than that, from whatever side they come (%j)', (guard) => {
    const { base, hullM, neededM } = guard;
    for (let k = 0; k < 48; k += 1) {
      for (const farM of [0.2, 0.6, hullM + neededM - 0.01, hullM + neededM + 0.01, 2.2]) {
        const at: Spot = [base[0] + farM * Math.cos(k * 0.131), base[1] + farM * Math.sin(k * 0.131)];
        expect(covered(guard, at), at.join()).toBe(gapTo(guard, at).gapM < neededM);
      }
    }
  });

  it('is measured from the hull, not from the middle of the base, and from the tool where that is nearer', () => {
    const [hull, tool] = [gapTo(around([2.1, 3]), [3.6, 3]), gapTo(around([2.9, 3]), [3.6, 3])];
    expect([hull.gapM, hull.from[0], tool.gapM, tool.from[0]].map((value) => value.toFixed(3))).toEqual(['1.150', '2.450', '0.700', '2.900']);
  });

  it('ties to whom it is least to, not to who is nearest to the base', () => {
    const [beside, ahead]: [Spot, Spot] = [[2, 4.3], [3.7, 3]];
    expect(leastGap(around([2.95, 3]), [beside, ahead])?.person).toEqual(ahead);
    expect(leastGap(around([2.1, 3]), [beside, ahead])?.person).toEqual(beside);
    expect(leastGap(around([2.1, 3]), [])).toBe(null);
  });

  it('turns the tool with the base, and is none where a part of it is not known', () => {
    const gauges: Record<string, number> = { protective_separation_m: 0.8, base_radius_m: 0.45, tcp_x_m: 0.6, tcp_y_m: 0.1 };
    const found = guardAt([2, 3], Math.PI / 2, (name) => gauges[name] ?? null);
    expect([found?.hullM, found?.neededM, ...(found?.tool.map((value) => value.toFixed(3)) ?? [])]).toEqual([0.45, 0.8, '1.900', '3.600']);
    for (const lost of Object.keys(gauges)) expect(guardAt([2, 3], 0, (name) => (name === lost ? null : (gauges[name] ?? null)))).toBe(null);
  });
});

/** Whether a point lies in one of the triangles that are drawn. */
function covered(guard: Guard, [x, y]: Spot): boolean {
  const side = ([ax, ay]: Spot, [bx, by]: Spot): number => (bx - ax) * (y - ay) - (by - ay) * (x - ax);
  return outline(guard).some(({ centre, rim }) => rim.slice(1).some(({ at: b }, k) => {
    const a = rim[k]?.at ?? b;
    const sides = [side(centre, a), side(a, b), side(b, centre)];
    return sides.every((one) => one >= 0) || sides.every((one) => one <= 0);
  }));
}
