import { describe, expect, it } from 'vitest';
import { Lasting, LASTING_MS, withLasting } from '../src/lib/live/lasting';
import { goingOn } from '../src/lib/live/held';
import { lastingOf, troubleOf, type Near } from '../src/lib/live/trouble';
import { cell, escalation, heldBy, scene } from './samples';

describe('a violation', () => {
  it('is shown at once, and until a while after it was last so', () => {
    const violations = new Lasting<string>();
    expect(violations.take({}, 0)).toEqual({});
    expect(violations.take({ zone: 'near' }, 10)).toEqual({ zone: 'near' });
    expect(violations.dueInMs(10)).toBeNull();
    expect(violations.take({}, 9_000)).toEqual({ zone: 'near' }); // until then it was so
    expect(violations.dueInMs(9_000)).toBe(LASTING_MS);
    expect(violations.take({}, 9_000 + LASTING_MS - 1)).toEqual({ zone: 'near' });
    expect(violations.take({}, 9_000 + LASTING_MS)).toEqual({});
    expect(violations.dueInMs(99_000)).toBeNull();
  });

  it('does not come and go with somebody at the very edge, who is told of once', () => {
    const violations = new Lasting<string>();
    const asked = escalation({ kind: 'session', reasons: [{ rule: 'runtime/session', code: 'separation', message: '', remedy: '' }] });
    const said = Array.from({ length: 40 }, (_, tick) => {
      const at = cell({ status: 'escalated', session: { ...heldBy(), violated: tick % 2 === 0 ? ['separation'] : [] } });
      return goingOn(asked, withLasting({ [at.id]: at }, violations, tick * 150)[at.id] ?? null, []).yes;
    });
    expect(new Set(said)).toEqual(new Set(['Go on once they have left']));
  });

  it('is that of its session, and of a cell that is clear nothing is changed', () => {
    const violations = new Lasting<string>();
    const [near, clear] = [cell({ busy: 'inv_1', session: { ...heldBy(), violated: ['separation'] } }), cell({ busy: 'inv_1', session: heldBy() })];
    withLasting({ a: near }, violations, 0);
    expect(withLasting({ a: { ...clear, busy: 'inv_2' } }, violations, 1)['a']?.session?.violated).toEqual([]);
    expect(withLasting({ a: clear }, violations, 2)['a']?.session?.violated).toEqual(['separation']);
    expect(withLasting({ a: clear }, violations, 2 + 2 * LASTING_MS)['a']).toBe(clear);
  });

  it('stays in the scene with what was measured then', () => {
    const violations = new Lasting<Partial<Near>>();
    const at = (separationM: number | null, nowMs: number): boolean => troubleOf(cell({}), lastingOf({ separationM, neededM: 1.02, zoneMarginM: 0.3 }, violations, nowMs), scene).separation;
    expect([at(1.03, 0), at(1.01, 100), at(1.03, 200), at(null, 300), at(1.01, 1_500), at(1.03, 1_600), at(1.03, 1_600 + LASTING_MS)]).toEqual([false, true, true, true, true, true, false]);
    expect(lastingOf({ separationM: 3, neededM: 1, zoneMarginM: -0.1 }, violations, 9_000).zoneMarginM).toBe(-0.1);
    expect(lastingOf({ separationM: 3, neededM: 1, zoneMarginM: 0.1 }, violations, 9_100)).toEqual({ separationM: 3, neededM: 1, zoneMarginM: -0.1 });
  });
});
