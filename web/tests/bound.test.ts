import { describe, expect, it } from 'vitest';
import { boundDifferences } from '../src/lib/fleet/bound';
import type { Rule } from '../src/lib/policy/matrix';

const rule = (id: string, over: Partial<Rule> = {}): Rule => ({
  id, applies_to: ['navigate_to'], profiles: [id.split('/')[0] ?? ''], when: null, then: 'modify', set: { clearance_m: { min: 0.3 } }, because: '', remedy: '', ...over,
});
const between = (...rules: Rule[]): string[] =>
  boundDifferences({ rules: rules as unknown as Record<string, unknown>[], profiles: {} }, [], 'floor', 'lab').map(({ what, from, to, way }) => `${what} | ${from} | ${to} | ${way}`);

describe('what holds in one of two profiles alone', () => {
  it('are rules that are bound to it: what is lost is looser, and what was an allowance stricter', () => {
    const clearance = 'Bounds: Clearance at least 0.3 m; Navigate to';
    expect(between(rule('floor/clearance'))).toEqual([`Rule “Clearance” | ${clearance} | no such rule | looser`]);
    expect(between(rule('lab/clearance'))).toEqual([`Rule “Clearance” | no such rule | ${clearance} | stricter`]);
    expect(between(rule('floor/free', { then: 'allow', set: {} }), rule('lab/open', { then: 'allow', set: {} })).map((row) => row.split(' | ').at(-1))).toEqual(['stricter', 'looser']);
    expect(between(rule('organization/night', { profiles: ['floor', 'yard'], then: 'deny', applies_to: null, when: 'night' }))).toEqual(['Rule “Night” | Denies; whatever is proposed, when night | no such rule | looser']);
  });

  it('are no rules that hold in both, in the same words or by the same name', () => {
    expect(between(rule('organization/x', { profiles: null }), rule('organization/y', { profiles: ['floor', 'lab'] }), rule('floor/clearance'), rule('lab/clearance', { because: 'Other words.' }), rule('yard/z'))).toEqual([]);
    expect(between(rule('floor/clearance'), rule('lab/clearance', { set: { clearance_m: { min: 0.1 } } }))).toEqual([
      'Rule “Clearance” | Bounds: Clearance at least 0.3 m; Navigate to | Bounds: Clearance at least 0.1 m; Navigate to | different',
    ]);
  });

  it('are phases that a person confirms, and capabilities that are forbidden', () => {
    const confirming = { capability: 'place_object', profile: 'floor', phases: ['release'], within_s: 60, on_deny: 'rollback', on_timeout: 'terminate' };
    const marked = [{ name: 'navigate_to', env_profile: { floor: 'guarded', lab: 'allowed' } }, { name: 'operate_tool', env_profile: { lab: 'allowed' } }];
    const found = (from: string, to: string): string[] => boundDifferences({ rules: [], profiles: {}, authority: { confirm_before: [confirming] } }, marked, from, to).map(({ what, way }) => `${what}: ${way}`);
    expect(found('floor', 'lab')).toEqual(['Operate tool: looser', 'Confirming during “Place object”: looser']);
    expect(found('lab', 'floor')).toEqual(['Operate tool: stricter', 'Confirming during “Place object”: stricter']);
    expect(found('yard', 'hall')).toEqual([]);
  });

  it('are rules that ask for another number of people', () => {
    const asks = (approvers: number | null): Partial<Rule> => ({ then: 'escalate', set: {}, approvers });
    expect(between(rule('floor/press', asks(2)), rule('lab/press', asks(null)))).toEqual(['Rule “Press” | Asks 2 people; Navigate to | Asks a person; Navigate to | different']);
  });

  it('are capabilities that a person is asked about by their mark, where both profiles ask alike', () => {
    const profile = (mode: string): Record<string, unknown> => ({ authority: { modes: [mode], approval: { risk: [] } } });
    const profiles = { floor: profile('approval-on-escalation'), lab: profile('approval-on-escalation'), yard: profile('review-only') };
    const marked = [
      { name: 'operate_tool', env_profile: { floor: 'approval-required', lab: 'guarded', yard: 'guarded' } },
      { name: 'retrace', recovery: true, env_profile: { floor: 'approval-required', lab: 'guarded', yard: 'guarded' } },
      { name: 'navigate_to', env_profile: { floor: 'guarded', lab: 'allowed', yard: 'allowed' } },
    ];
    const found = (from: string, to: string): string[] => boundDifferences({ rules: [], profiles }, marked, from, to).map((one) => Object.values(one).join(' | '));
    expect(found('floor', 'lab')).toEqual(['Operate tool | asks a person | asks no one by itself | looser']);
    expect(found('lab', 'floor')).toEqual(['Operate tool | asks no one by itself | asks a person | stricter']);
    expect(found('floor', 'yard')).toEqual([]);
  });
});
