import { describe, expect, it } from 'vitest';
import type { Cell, LogEvent, WatchRule } from '../src/lib/api/documents';
import { differences, type ProfileFacts } from '../src/lib/fleet/profiles';
import { takesOver } from '../src/lib/fleet/takes';
import type { Watching } from '../src/lib/fleet/watched';
import { isNews, lastStopBy, secondsLeft, stopOf, stoppedElsewhere, unheardOf, VOIDED, whyWithdrawn } from '../src/lib/live/reset';
import { peopleWords } from '../src/lib/fleet/people';
import { heard, profileBarrier, resetBarrier, samePolicy } from '../src/lib/fleet/rights';
import { event } from './samples';

const cell = (over: Partial<Cell> = {}): Cell => ({
  id: 'workcell-1', online: true, latched: true, profile: 'human-shared', busy: null, status: null, holding_link: false, robot: null, policy_version: 'sha256:1', facts: null, gauges: {}, ...over,
});
const STRICT = { sensitivity: 0.9, limits: { tcp_speed_mps: { max: 0.25 }, payload_kg: { max: 3 } }, authority: { modes: ['approval-required'] } };
const LOOSE = { sensitivity: 0.3, limits: { tcp_speed_mps: { max: 1.5 }, payload_kg: { max: 3 } }, authority: { modes: ['review-only'] } };

describe('how near people are', () => {
  it('is what Live shows where a session measures it, and otherwise says from where it is measured', () => {
    const facts = { people_count: 1, people_nearest_m: 1.08 };
    expect(peopleWords(cell({ facts, gauges: { separation_m: 0.61 } }))).toBe('1, separation 0.61 m');
    for (const gauges of [{}, { separation_m: 99 }, { separation_m: null as unknown as number }]) {
      expect(peopleWords(cell({ facts, gauges }))).toBe('1, nearest 1.08 m from the middle of the base');
    }
    expect([{ people_count: 0, people_nearest_m: 99 }, null].map((seen) => peopleWords(cell({ facts: seen })))).toEqual(['nobody seen', 'not known']);
  });
});

describe('who may act', () => {
  it.each([
    ['operator', true, true],
    ['engineer', true, false],
    ['auditor', false, false],
    [null, false, false],
  ])('%s: profile %s, reset %s', (role, profile, reset) => {
    expect(profileBarrier({ role, live: true }) === null).toBe(profile);
    expect(resetBarrier({ role, live: true, cell: cell() }) === null).toBe(reset);
  });

  it('nobody takes the controls under a profile that does not say so; one that is not read yet is the server’s to judge', () => {
    expect([STRICT, { authority: { modes: ['interrupt-enabled', 'takeover-enabled'] } }, {}, undefined].map(takesOver)).toEqual([false, true, false, true]);
  });

  it('nobody does while the link is down', () => {
    expect(profileBarrier({ role: 'operator', live: false })).toContain('link is down');
    expect(resetBarrier({ role: 'operator', live: false, cell: cell() })).toContain('link is down');
  });
});

describe('the second step of a reset', () => {
  const offered = { by: 'ann', code: '1', sinceMs: Date.parse('2026-01-01T00:00:10Z'), untilMs: Date.parse('2026-01-01T00:00:20Z') };
  const stop = (at: string, name: string): LogEvent => ({ ...event('human', { op: 'estop', cell: name }, null, 'operator_2'), at });
  const [before, after, elsewhere] = [stop('2026-01-01T00:00:09Z', 'workcell-1'), stop('2026-01-01T00:00:12Z', 'workcell-1'), stop('2026-01-01T00:00:12Z', 'workcell-2')];

  it('stands until its time is over', () => {
    expect([offered.untilMs - 1_500, offered.untilMs, offered.untilMs + 1].map((now) => secondsLeft(offered, now))).toEqual([2, 0, 0]);
    expect(whyWithdrawn(offered, 'workcell-1', [before, elsewhere], offered.untilMs - 1, 'ann')).toBeNull();
    expect(whyWithdrawn(offered, 'workcell-1', [], offered.untilMs, 'ann')).toContain('time to confirm is over');
    expect(whyWithdrawn(offered, 'workcell-1', [], offered.untilMs - 500, null)).toContain('time to confirm is over');
  });

  it('falls with whatever voids it, and says whose that is where it knows', () => {
    const now = offered.untilMs - 2_000;
    expect(whyWithdrawn(offered, 'workcell-1', [], now, 'bob')).toContain('bob has begun to reset it since');
    expect(whyWithdrawn(offered, 'workcell-1', [], now, null)).toBe(VOIDED);
  });

  it('falls with a new stop, and says whose', () => {
    expect(whyWithdrawn(offered, 'workcell-1', [before, after], offered.untilMs, null)).toContain('operator_2 has pressed the stop again');
  });
});

describe('the stop a cell is latched by', () => {
  const word = (op: string, by: string, name = 'workcell-1'): LogEvent => event('human', { op, cell: name }, null, by);
  it('is the first one since the reset before it, of this cell', () => {
    const log = [word('estop', 'ann'), word('reset', 'ann'), word('estop', 'eve', 'workcell-2'), word('estop', 'bob'), word('estop', 'ann')];
    expect(stopOf('workcell-1', log)).toEqual({ by: 'bob', at: '2026-11-22T10:00:01.000Z' });
  });
  it('is told of every cell but the one that is looked at, and as confirmed only where the cell is heard', () => {
    const log = [word('estop', 'eve', 'workcell-2')];
    const cells = ['workcell-1', 'workcell-2', 'workcell-3', 'workcell-4'].map((id, k) => cell({ id, latched: k < 3, online: k < 2 }));
    expect(stoppedElsewhere(cells, 'workcell-1', log)).toEqual([{ cell: 'workcell-2', heard: true, stop: { by: 'eve', at: log[0]?.at } }, { cell: 'workcell-3', heard: false, stop: null }]);
    expect(isNews({ by: 'eve', at: '2026-01-01T10:00:00Z' }, '2026-01-01T09:00:00Z')).toBe(true); // right behind a reset
    expect(isNews({ by: 'eve', at: '2026-01-01T10:00:00Z' }, '2026-01-01T10:00:00Z')).toBe(false);
    expect([isNews(null, undefined), isNews(null, '2026-01-01T09:00:00Z'), isNews({ by: 'eve', at: '2026-01-01T10:00:00Z' }, null)]).toEqual([true, false, false]);
  });
  it('was last pressed by somebody where the record says so of them and of this cell', () => {
    const log = [word('estop', 'ann'), word('estop', 'bob'), word('reset', 'ann'), word('estop', 'ann', 'workcell-2')];
    expect([lastStopBy('ann', 'workcell-1', log), lastStopBy('bob', 'workcell-1', log), lastStopBy('eve', 'workcell-1', log)]).toEqual([log[0]?.seq, log[1]?.seq, null]);
  });
  it('is the same one after a reset that the cell has not heard', () => {
    const unheard = event('cell', { what: 'not_confirmed', op: 'reset', cell: 'workcell-1' }, null, 'server');
    const log = [word('estop', 'ann'), word('reset', 'bob'), unheard];
    expect(stopOf('workcell-1', log)?.by).toBe('ann');
    expect(stopOf('workcell-1', [...log, word('reset', 'bob'), unheard])?.by).toBe('ann');
    expect(stopOf('workcell-1', [...log, word('reset', 'bob')])).toBeNull();
    expect(stopOf('workcell-1', [...log.slice(0, 2), word('estop', 'eve'), unheard])?.by).toBe('eve');
    expect([log, log.slice(0, 2), [...log, word('estop', 'eve')], [...log, word('reset', 'bob')]].map((words) => unheardOf('workcell-1', words))).toEqual(['bob', null, null, null]);
    expect(unheardOf('workcell-2', log)).toBeNull();
    const left = [...log, event('cell', { what: 'confirmed', op: 'reset', cell: 'workcell-1' }, null, 'server')];
    expect([stopOf('workcell-1', left), unheardOf('workcell-1', left)]).toEqual([null, null]);
  });
  it('is not known where the record of it is not here', () => {
    expect(stopOf('workcell-1', [word('estop', 'ann'), word('reset', 'ann')])).toBeNull();
  });
});

describe('a cell', () => {
  it('is heard, holding, or silent', () => {
    expect([cell(), cell({ holding_link: true }), cell({ online: false, holding_link: true })].map((it) => heard(it).tone)).toEqual(['ok', 'warn', 'danger']);
  });

  it('may run on another policy than the one in force', () => {
    expect([samePolicy(cell(), 'sha256:1'), samePolicy(cell(), 'sha256:2'), samePolicy(cell({ policy_version: null }), 'sha256:1')]).toEqual([true, false, null]);
  });
});

describe('a change of profile', () => {
  const rule = (over: Partial<WatchRule>): WatchRule => ({
    id: 'slip', applies_to: null, signal: 'slip_m', above: true, threshold: 0.012, for_ms: 20,
    response: { enter: 'STOP', clear_after_ms: 0, clear_beyond: 0, then: 'stay', persist_ms: null, else: 'ESCALATE' }, ...over,
  });
  const near = (id: string, threshold: WatchRule['threshold'], over: Partial<WatchRule['response']>): WatchRule =>
    rule({ id, signal: 'separation_m', above: false, threshold, for_ms: 0, response: { ...rule({}).response, ...over } });
  const watching = (...watch: WatchRule[]): Watching => ({ watch, stale_after_ms: { arm: 50 }, separation: null });
  const waits = { enter: 'PAUSE', clear_after_ms: 1000, clear_beyond: 0.05, then: 'resume', persist_ms: 5000 };
  const watchedOf = (a: Watching, b: Watching): string[] => differences(STRICT, STRICT, [a, b]).map(({ what, from, to, way }) => `${what} | ${from} | ${to} | ${way}`);
  const modes = (...named: string[]): ProfileFacts => ({ authority: { modes: named } });

  it('says what becomes looser', () => {
    expect(differences(STRICT, LOOSE)).toEqual([
      { what: 'Asking people', from: 'approval-required', to: 'nobody is asked', way: 'looser' },
      { what: 'Tool speed, at most', from: '0.25 m/s', to: '1.50 m/s', way: 'looser' },
      { what: 'Watcher sensitivity', from: '0.9', to: '0.3', way: 'looser' },
    ]);
  });

  it('calls nothing looser on the way back, and nothing changed to itself', () => {
    expect(differences(LOOSE, STRICT).some(({ way }) => way !== 'stricter')).toBe(false);
    const facts = (over: ProfileFacts): ProfileFacts => ({ shared_floor: true, rollback: 'required', modes: ['normal', 'careful'], ...over });
    const rest = (over: ProfileFacts): string[] => differences(facts({}), facts(over)).map((one) => Object.values(one).join(' | '));
    expect(rest({ shared_floor: false, rollback: 'optional', modes: ['careful'] })).toEqual([
      'Floor | shared with people | not shared | looser', 'Undoing what failed | required | optional | looser', 'Modes that agents may choose | careful, normal | careful | stricter',
    ]);
    expect(rest({ rollback: 'always', modes: ['careful', 'normal'] })).toEqual(['Undoing what failed | required | always | stricter']);
    expect(differences(STRICT, STRICT, [watching(rule({})), watching(rule({}))])).toEqual([]);
  });

  it('says first what becomes of people who come near, by whatever name it is watched', () => {
    const [shared, relaxed] = [watching(rule({}), near('separation', 'protective_separation_m', waits)), watching(rule({}), near('people', 0.5, { enter: 'CONTINUE' }))];
    const pauses = 'below the protective distance, pauses, goes on 1 s after it is clear by 0.05 m, asks a person after 5 s';
    expect(differences(STRICT, LOOSE, [shared, relaxed])[0]).toEqual({ what: 'A person too near', from: pauses, to: 'below 0.50 m, only warns', way: 'looser' });
    expect(differences(LOOSE, STRICT, [relaxed, shared])[0]?.way).toBe('different');
    expect(watchedOf(shared, watching(rule({})))).toEqual([`A person too near | ${pauses} | not watched | looser`]);
  });

  it('says which other rules of the watcher differ, and whether they come later', () => {
    const before = watching(rule({}), rule({ id: 'retries', signal: 'retries', threshold: 'retry_budget', response: { ...rule({}).response, enter: 'ESCALATE' } }), rule({ id: 'grip-force', threshold: { limit: 'grip_force_n', times: 1.05 } }));
    const after = watching(rule({ threshold: 0.025, for_ms: 0 }), rule({ id: 'retries', signal: 'retries', threshold: 'retry_budget' }), rule({ id: 'grip-force', threshold: { limit: 'grip_force_n', times: 1.01 }, applies_to: ['grasp_object'] }));
    expect(watchedOf(before, { ...after, stale_after_ms: { arm: 75 } })).toEqual([
      'Slip | above 0.012 m, for 20 ms | above 0.025 m, at once | looser',
      'Retries | asks a person | stops | different',
      'Grip force | above 105 % of its limit, whatever runs | above 101 % of its limit, in Grasp object | looser',
      'Sensor stale after | arm 50 ms | arm 75 ms | looser',
    ]);
    const held = (over: Partial<WatchRule['response']>): Watching => watching(rule({ id: 'stale', response: { ...rule({}).response, ...waits, ...over } }));
    expect(watchedOf(held({}), held({ else: 'STOP' }))).toEqual(['Sensor stale | asks a person after 5 s | stops after 5 s | different']);
    expect(watchedOf(after, before).map((line) => line.split(' | ').at(-1))).toEqual(['looser', 'different', 'looser']);
    expect(watchedOf(watching(), watching(rule({})))).toEqual(['Slip | not watched | above 0.012 m, stops | stricter']);
  });

  it('says who is asked about which risk, and what people may do no longer', () => {
    const asks = (...risk: string[]): ProfileFacts => ({ authority: { modes: ['approval-required'], approval: { risk } } });
    expect(differences(asks('high', 'medium'), asks('high'))).toEqual([{ what: 'Asking people', from: 'approval-required: high, medium risk', to: 'approval-required: high risk', way: 'looser' }]);
    expect(differences(asks('high'), asks('high', 'medium'))[0]?.way).toBe('stricter');
    const takes = (approvers: Record<string, number>): ProfileFacts => ({ authority: { modes: ['approval-required'], approval: { risk: ['high'], approvers } } });
    expect(differences(takes({ default: 2 }), takes({ default: 1, critical: 2 }))).toEqual([
      { what: 'People who have to approve', from: '2 for low risk, 2 for medium risk, 2 for high risk', to: '1 for low risk, 1 for medium risk, 1 for high risk', way: 'looser' },
    ]);
    expect(differences(takes({ critical: 1 }), takes({ default: 1, critical: 2 }))[0]?.way).toBe('stricter');
    expect(differences(modes('interrupt-enabled', 'takeover-enabled'), modes())).toEqual([
      { what: 'Taking the controls', from: 'people may', to: 'nobody may', way: 'different' },
      { what: 'Pausing what runs', from: 'people may', to: 'nobody may', way: 'looser' },
    ]);
    const reviewed: ProfileFacts = { authority: { modes: ['review-only'], review: { risk: ['critical'], outcomes: ['taken_over'] } } };
    expect(differences(reviewed, modes())).toEqual([{ what: 'Review of what is over', from: 'critical risk: taken over', to: 'nothing waits for a verdict', way: 'looser' }]);
  });
});
