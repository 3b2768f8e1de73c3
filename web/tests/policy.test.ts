import { describe, expect, it } from 'vitest';
import type { Capability, Decided, InputSchema, PolicySet } from '../src/lib/api/documents';
import { decidedRows } from '../src/lib/policy/decided';
import { boundText, confirmRule, confirmText, effectOf, moved, rulesFor, squareOf, type Rule } from '../src/lib/policy/matrix';
import { fieldsOf, readConfidence, readParams, verdictWords } from '../src/lib/policy/proposal';

const rule = (over: Partial<Rule>): Rule => ({ id: 'organization/r', applies_to: null, profiles: null, when: null, then: 'modify', set: {}, because: '', remedy: '', ...over });
const RULES = [
  rule({ id: 'human-shared/clearance', profiles: ['human-shared'], applies_to: ['drive'], set: { clearance_m: { min: 0.3 } } }),
  rule({ id: 'organization/fragile', when: 'target.fragile', set: { speed_mps: { max: 0.15 } } }),
  rule({ id: 'organization/other', applies_to: ['grasp'], then: 'deny' }),
];
const policy = (over: Record<string, unknown> = {}): PolicySet => ({
  version: 'sha256:0', capabilities: [], agents: {}, rules: RULES as unknown as PolicySet['rules'],
  site: { targets: { dock: {}, bench_a_stand: {} }, tools: { lever: { actions: { pull_down: 'down' } }, press: { actions: { press: 'pressed' } } } },
  profiles: {
    'human-shared': {
      limits: { base_speed_mps: { max: 0.3 } },
      authority: { modes: ['approval-required'], approval: { risk: ['medium', 'critical'], within_s: 120, on_timeout: 'deny', approvers: { default: 1, critical: 2 } } },
    },
    relaxed: { limits: { base_speed_mps: { max: 9 } }, authority: { modes: ['review-only'], approval: null } },
  },
  ...over,
});
const drive = (over: Partial<Capability> = {}): Capability => ({
  name: 'drive', version: '1', summary: '', risk: 'low', env_profile: { 'human-shared': 'guarded', relaxed: 'allowed' },
  inputs: {
    required: ['target'],
    properties: {
      target: { type: 'string', 'x-ref': 'target' },
      speed_mps: { type: 'number', unit: 'm/s', minimum: 0.05, maximum: 2, default: 0.3, 'x-limit': 'base_speed_mps' },
      clearance_m: { type: 'number', unit: 'm', minimum: 0.1, maximum: 1 },
    },
  },
  ...over,
});

describe('the matrix', () => {
  it('bounds a parameter by the tightest of schema, limit and rule, and says which', () => {
    const square = squareOf(policy(), drive(), 'human-shared');
    const [speed, clearance] = square.bounds;
    expect(speed).toMatchObject({ min: 0.05, max: 0.3, maxBy: 'base_speed_mps', tightened: true });
    expect(clearance).toMatchObject({ min: 0.3, max: 1, minBy: 'human-shared/clearance', tightened: true });
    expect(square.bounds.map(boundText)).toEqual(['Speed 0.05 to 0.3 m/s', 'Clearance 0.3 to 1 m']);
    expect(square.standing).toBe('bounded');
  });

  it('allows freely where nothing is tighter than the schema', () => {
    const square = squareOf(policy(), drive(), 'relaxed');
    expect([square.standing, square.nobodyAnswers]).toEqual(['allowed', true]);
  });

  it('keeps rules that depend on the proposal apart from those that always hold', () => {
    const square = squareOf(policy(), drive(), 'human-shared');
    expect([square.always, square.sometimes].map((rules) => rules.map(({ id }) => id))).toEqual([['human-shared/clearance'], ['organization/fragile']]);
    expect(rulesFor(policy(), 'grasp', 'relaxed').map(({ id }) => id)).toEqual(['organization/fragile', 'organization/other']);
  });

  it.each([
    ['by its risk', drive({ risk: 'critical' }), 2],
    ['by its mark', drive({ env_profile: { 'human-shared': 'approval-required' } }), 1],
  ])('asks people %s', (_, capability, people) => {
    expect(squareOf(policy(), capability, 'human-shared')).toMatchObject({ standing: 'asks', asks: { people } });
  });

  it('asks nobody about a recovery', () => {
    expect(squareOf(policy(), drive({ risk: 'medium', recovery: true }), 'human-shared').asks).toBeNull();
  });

  it.each([
    ['is marked so', policy(), drive({ env_profile: { 'human-shared': 'forbidden' } })],
    ['is not marked at all', policy(), drive({ env_profile: {} })],
    ['an unconditional rule denies it', policy({ rules: [rule({ then: 'deny' })] }), drive()],
  ])('forbids what %s', (_, set, capability) => {
    expect(squareOf(set, capability, 'human-shared').standing).toBe('forbidden');
  });

  it('shows what a person confirms in mid-execution, in that square alone', () => {
    const entry = { capability: 'drive', profile: 'human-shared', phases: ['settle', 'let_go'], within_s: 60, on_deny: 'rollback', on_timeout: 'terminate' };
    const others = [{ ...entry, capability: 'grasp' }, { ...entry, profile: 'relaxed', phases: ['drive'], on_deny: 'terminate' }];
    const set = policy({ authority: { confirm_before: [others[0], entry, others[1]] } });
    const [here, there] = ['human-shared', 'relaxed'].map((profile) => squareOf(set, drive(), profile).confirms);
    expect([here, there].map((found) => confirmText(found ?? []))).toEqual(['Confirm before settle, let go', 'Confirm before drive']);
    expect([here, there].map((found) => found?.map(confirmRule))).toEqual([
      ['Before settle and before let go the robot holds and waits for one person, at most 60 s; a denial has it rolled back, silence ends the session.'],
      ['Before drive the robot holds and waits for one person, at most 60 s; a denial or silence ends the session.'],
    ]);
    expect(confirmText(squareOf(set, drive({ name: 'other' }), 'human-shared').confirms)).toBe('');
    expect(squareOf(policy(), drive(), 'human-shared').confirms).toEqual([]);
  });

  it('says what a rule does', () => {
    expect(effectOf(rule({ set: { force_n: { max: 20 }, speed_mps: { max: 0.15 } } }))).toBe('Bounds: Grip force at most 20 N; Speed at most 0.15 m/s');
    expect(effectOf(rule({ set: { corridor: { to: 'place.corridor' } } }))).toBe('Bounds: Corridor: place.corridor');
  });

  it('keeps arrow keys within its edges', () => {
    expect([moved([0, 0], 'ArrowUp', 3, 2), moved([0, 0], 'ArrowRight', 3, 2), moved([2, 1], 'ArrowDown', 3, 2), moved([1, 1], 'Home', 3, 2)]).toEqual([[0, 0], [0, 1], [2, 1], [1, 0]]);
  });
});

describe('the what-if form', () => {
  it('offers the names the site knows', () => {
    const [target, speed] = fieldsOf(drive(), policy());
    expect(target).toMatchObject({ kind: 'choice', required: true, choices: ['bench_a_stand', 'dock'] });
    expect(speed).toMatchObject({ kind: 'number', unit: 'm/s', hint: '0.05 to 2, 0.3 if left out' });
  });

  it('offers what can be done with the chosen tool', () => {
    const operate = drive({ inputs: { properties: { tool: { type: 'string', 'x-ref': 'tool' }, action: { type: 'string', 'x-ref': 'action' } } } });
    expect(fieldsOf(operate, policy())[1]?.choices).toEqual(['pull_down', 'press']);
    expect(fieldsOf(operate, policy(), { tool: 'press' })[1]?.choices).toEqual(['press']);
  });

  it('leaves out what is empty, reads a decimal comma, and lets the server judge ranges', () => {
    const fields = fieldsOf(drive(), policy());
    expect(readParams(fields, { target: 'dock', speed_mps: '0,5', clearance_m: '' })).toEqual({ params: { target: 'dock', speed_mps: 0.5 }, faults: {} });
    expect(readParams(fields, { target: 'dock', speed_mps: '99' }).faults).toEqual({});
    expect(readParams(fields, { speed_mps: 'fast' }).faults).toEqual({ target: 'needed', speed_mps: 'a number, please' });
  });

  it.each([
    ['0,5', 0.5], [' .25 ', 0.25], ['1', 1], ['', null], ['0x1', undefined], ['1e-1', undefined], ['Infinity', undefined], ['-0.1', undefined], ['1.01', undefined],
  ])('reads %j as a confidence as its other numbers are read', (text, confidence) => {
    expect(readConfidence(text)).toBe(confidence);
  });

  it('says why people are asked, how many, and within what time', () => {
    const reason = (message: string) => ({ rule: 'r', code: 'c', message, remedy: '' });
    const asks = { reasons: [reason('medium risk needs approval in human-shared')], needed: 1, within_s: 120 };
    expect(verdictWords({ status: 'awaiting_approval', asks })).toMatchObject({ word: 'Asks a person:', says: 'medium risk needs approval in human-shared; 1 approval within 120 s.' });
    const two = { reasons: [reason('The press needs two.'), reason('`operate_tool` needs approval')], needed: 2, within_s: 300 };
    expect(verdictWords({ status: 'awaiting_approval', asks: two }).says).toBe('The press needs two; “operate_tool” needs approval; 2 approvals within 300 s.');
    expect(verdictWords({ status: 'awaiting_approval' }).says).toBe('It would wait until people approve it.');
  });
});

describe('a decision under two versions', () => {
  const of = (over: Partial<Decided>): Decided => ({ what: 'allow', approvers: 0, values: {}, rules: [], ...over });

  it('says the outcome, every value with its unit, and by which rules', () => {
    const before = of({ what: 'approve', approvers: 2, values: { force_n: 60, object_id: 'mug_1' }, rules: ['a/b', 'c/d'] });
    const after = of({ what: 'deny', rules: ['e/f'] });
    const inputs = { force_n: { 'x-limit': 'contact_force_n' } } as unknown as Record<string, InputSchema>;
    expect(decidedRows(before, after, inputs)).toEqual([
      { about: 'Outcome', before: 'asks 2 people', after: 'denied' },
      { about: 'Contact force', before: '60 N', after: '–' },
      { about: 'Object', before: 'mug_1', after: '–' },
      { about: 'By', before: 'a/b, c/d', after: 'e/f' },
    ]);
    expect(decidedRows(of({}), of({ what: 'approve', approvers: 1 }), {})[0]).toEqual({ about: 'Outcome', before: 'launched', after: 'asks one person' });
  });
});
