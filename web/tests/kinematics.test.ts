import { describe, expect, it } from 'vitest';
import { bodiesOf, LINKS, toolError, toolOf } from '../src/lib/audit/kinematics';

const HOME = [-0.45998431742191315, -2.119, 2.018, -1.4698, -1.5708, 1.1108];

describe('the drawn robot', () => {
  it('has its tool where the recorded session measured it', () => {
    // Three rows of a real session: joint angles and tool position as its telemetry holds them.
    const rows: [number[], [number, number, number]][] = [
      [[-0.45998433232307434, -2.1190006732940674, 2.018024206161499, -1.4697870016098022, -1.5708256959915161, 1.1107951402664185], [0.4196774661540985, 0.00028480912442319095, 1.000153660774231]],
      [[0.037629395723342896, -1.3294802904129028, 1.8719745874404907, -2.1133034229278564, -1.570798635482788, 1.6084022521972656], [0.651764452457428, 0.15341325104236603, 0.8081039786338806]],
      [[-0.10634882003068924, -1.7391040325164795, 1.7820005416870117, -1.6136988401412964, -1.570815086364746, 1.4644787311553955], [0.5521215200424194, 0.08792275190353394, 1.0000762939453125]],
    ];
    for (const [joints, measured] of rows) expect(toolError(joints, measured)).toBeLessThan(0.002);
  });

  it('moves as a whole with its base', () => {
    const still = bodiesOf({ base: [0, 0, 0], joints: HOME, gripWidthM: 0.08 });
    const turned = bodiesOf({ base: [2, 3, Math.PI / 2], joints: HOME, gripWidthM: 0.08 });
    for (const name of ['base', ...LINKS, 'gripper', 'finger_left', 'finger_right']) {
      const [x, y, z] = still.get(name)?.at ?? [NaN, NaN, NaN];
      const moved = turned.get(name)?.at ?? [NaN, NaN, NaN];
      expect(moved[0]).toBeCloseTo(2 - y, 9);
      expect(moved[1]).toBeCloseTo(3 + x, 9);
      expect(moved[2]).toBeCloseTo(z, 9);
    }
  });

  it('holds its fingers as far apart as the gripper is wide', () => {
    const bodies = bodiesOf({ base: [1, 1, 0.3], joints: HOME, gripWidthM: 0.06 });
    const [a, b] = [bodies.get('finger_left')?.at ?? [0, 0, 0], bodies.get('finger_right')?.at ?? [0, 0, 0]];
    expect(Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2])).toBeCloseTo(0.06, 9);
  });

  it('does not agree with the tool of another robot', () => {
    const [x, y, z] = toolOf(HOME);
    expect(toolError(HOME, [x, y, z + 0.05])).toBeCloseTo(0.05, 9);
  });
});
