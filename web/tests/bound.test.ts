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
      'Rule “Clearance” | Bounds: Clearance at least 0.3 m; Navigate to | Bounds: Clearance at least 0.1 m; Navigate to | looser',
    ]);
  });

  it('are rules by the same name of which one is stricter, if both are about the same', () => {
    const way = (mine: Partial<Rule>, other: Partial<Rule>): string | undefined => between(rule('floor/x', mine), rule('lab/x', other))[0]?.split(' | ').at(-1);
    const force = (bound: Rule['set'][string]): Partial<Rule> => ({ set: { force_n: bound } });
    expect([way({ then: 'deny' }, { then: 'escalate' }), way({ then: 'allow' }, { then: 'modify' })]).toEqual(['looser', 'stricter']);
    expect([way(force({ max: 60 }), force({ max: 80 })), way(force({ max: 60 }), force({ min: 1, max: 60 })), way(force({ max: 60 }), { set: {} })]).toEqual(['looser', 'stricter', 'looser']);
    expect([way(force({ to: 1 }), force({ to: 2 })), way({ when: 'a' }, { when: 'b' }), way(force({ max: 60 }), { ...force({ max: 80 }), when: 'a' })]).toEqual(['different', 'different', 'different']);
    expect([way({ then: 'escalate', approvers: 2 }, { then: 'escalate', approvers: 1 }), way({ then: 'deny', because: 'x' }, { then: 'deny', set: {} })]).toEqual(['looser', 'different']);
  });

  it('are rules that go by a floor that people share', () => {
    const press = rule('organization/press-two-approvers', { profiles: null, then: 'escalate', set: {}, approvers: 2, when: 'tool.press && profile.shared_floor' });
    const other = rule('organization/else', { profiles: null, when: '!profile.shared_floor' });
    const either = rule('organization/either', { profiles: null, when: 'tool.press || profile.shared_floor' });
    const rules = [press, other, either] as unknown as Record<string, unknown>[];
    const found = (from: boolean, to: boolean): string[] => boundDifferences({ rules, profiles: { floor: { shared_floor: from }, lab: { shared_floor: to } } }, [], 'floor', 'lab').map(({ what, way }) => `${what}: ${way}`);
    expect(found(true, false)).toEqual(['Rule “Press two approvers”: looser', 'Rule “Else”: stricter', 'Rule “Either”: different']);
    expect([found(true, true), found(false, false)]).toEqual([[], []]);
  });

  it('are rules that go by the profile, or may do so', () => {
    const found = (when: string, profiles: Record<string, Record<string, unknown>> = { floor: { shared_floor: true, sensitivity: 1 }, lab: { shared_floor: false, sensitivity: 1 } }): string[] => {
      const rules = [rule('organization/x', { profiles: null, then: 'deny', when })] as unknown as Record<string, unknown>[];
      return boundDifferences({ rules, profiles }, [], 'floor', 'lab').map(({ to, way }) => `${way}${to.startsWith('may differ') ? '?' : ''}`);
    };
    expect(['profile.name == "floor"', "tool.press && profile.name != 'lab'", 'profile.name != "floor"', 'profile.name == "yard"', 'profile.name != "yard"'].map((when) => found(when))).toEqual([['looser'], ['looser'], ['stricter'], [], []]);
    const unknown = [
      'profile.name in ["floor", "hall"]', 'profile.name == "floor" || tool.press', 'profile.shared_floor ? tool.press : true', '!(tool.press && profile.shared_floor && place.near)',
      'profile.name.startsWith("f")', 'tool.press && !(profile.name == "lab")', 'metadata.intent == "a && profile.shared_floor && b"', 'profile == agent', '(profile.shared_floor)',
    ];
    expect(unknown.map((when) => found(when))).toEqual(unknown.map(() => ['different?']));
    expect([found('profile.sensitivity > 0.5'), found('metadata.profile == "x"'), found('tool.press')]).toEqual([[], [], []]);
    expect([found('profile.sensitivity > 0.5', { floor: { sensitivity: 1 }, lab: { sensitivity: 0.2 } }), found('tool.press && profile.shared_floor', {})]).toEqual([['different?'], ['different?']]);
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

  it('are capabilities that are asked about no more by their mark, also where more is asked about by its risk', () => {
    const profile = (...risk: string[]): Record<string, unknown> => ({ authority: { modes: ['approval-required'], approval: { risk } } });
    const profiles = { floor: profile('high'), lab: profile('high', 'medium') };
    const marked = ['low', 'medium', 'high'].map((risk) => ({ name: risk, risk: risk as 'low', env_profile: { floor: 'approval-required', lab: 'guarded' } }));
    const found = (from: string, to: string): string[] => boundDifferences({ rules: [], profiles }, marked, from, to).map(({ what, way }) => `${what}: ${way}`);
    expect([found('floor', 'lab'), found('lab', 'floor')]).toEqual([['Low: looser'], ['Low: stricter']]);
  });
});
