import { describe, expect, it } from 'vitest';
import type { Escalation, Invocation, LogEvent, Risk } from '../src/lib/api/documents';
import { gaugesFor, noneOf, readGauge, unfinished, type GaugeSpec } from '../src/lib/live/gauges';
import { History } from '../src/lib/live/history';
import { handsOn, holdersOf, inControl, isPast, lossOf, pausedWords, pauseEndedOf, pauserOf, refusalWords, restraintsOf, standingLease, unreachedWords } from '../src/lib/live/control';
import { deniedIsUndone, goingOn } from '../src/lib/live/held';
import { reasonLines } from '../src/lib/live/reasons';
import { askedOf, stagesOf } from '../src/lib/live/stages';
import { troubleOf, zonesAt } from '../src/lib/live/trouble';
import { byUrgency, currentOf, graverThan } from '../src/lib/live/urgency';
import { cell, escalation, event, heldBy, invocation, scene } from './samples';

const NOW = Date.parse('2026-11-22T10:00:00Z');
const after = (seconds: number): string => new Date(NOW + seconds * 1000).toISOString();

function asked(id: string, risk: Risk, seconds: number, more: Partial<Escalation> = {}): Escalation {
  return escalation({ id, risk, expires_at: after(seconds), ...more });
}

function order(items: Escalation[], me: string | null = 'operator'): string[] {
  return [...items].sort(byUrgency(NOW, me)).map((item) => item.id);
}

describe('who is in control', () => {
  it('is not known of a cell that is not heard', () => {
    const [session, control] = [invocation(), { lease: 'l', cell: 'workcell-1', holder: 'ann', where: 'remote', since: '', invocation: 'inv_1', phase: 'held', refused: null }];
    const said = (of: object): string => inControl(cell({ busy: session.id, control: null, ...of }), session, 'ann').long;
    expect([said({}), said({ control }), said({ busy: null })]).toEqual(['Agent “planner”', 'You (remote)', 'Nobody']);
    expect([said({ online: false }), said({ online: false, control })]).toEqual(['Not known', 'Not known']);
  });
});

describe('what waits for me is sorted', () => {
  it('by risk, and within one risk by the nearer deadline', () => {
    expect(order([asked('low', 'low', 60), asked('later', 'high', 100), asked('sooner', 'high', 90)])).toEqual(['sooner', 'later', 'low']);
  });

  it('with a robot held in mid-motion before any proposal', () => {
    expect(order([asked('critical', 'critical', 90), asked('held', 'low', 300, { kind: 'session' })])).toEqual(['held', 'critical']);
  });

  it('with what lapses within 30 s before everything else', () => {
    expect(order([asked('held', 'high', 300, { kind: 'session' }), asked('last call', 'low', 20)])).toEqual(['last call', 'held']);
  });

  it('with what I approved already at the end, for me alone', () => {
    const mine = asked('mine', 'critical', 90, { approvals: [{ by: 'operator', at: after(0), digest: 'd' }], needed: 2 });
    expect(order([mine, asked('other', 'low', 90)])).toEqual(['other', 'mine']);
    expect(order([mine, asked('other', 'low', 90)], 'operator_2')).toEqual(['mine', 'other']);
  });

  it('the same way whatever order it came in', () => {
    const twins = [asked('b', 'low', 90), asked('a', 'low', 90), asked('c', 'low', 90, { expires_at: null })];
    expect(order(twins)).toEqual(order([...twins].reverse()));
  });
});

describe('what is more urgent than the question that is open', () => {
  it('is of a higher class, and not merely older by a second', () => {
    const sorted = [asked('held', 'low', 300, { kind: 'session' }), asked('high', 'high', 90), asked('older', 'low', 59), asked('open', 'low', 60)];
    expect(graverThan(sorted, 'open', NOW, 'operator').map(({ id }) => id)).toEqual(['held', 'high']);
    expect([graverThan(sorted, 'held', NOW, 'operator'), graverThan(sorted, null, NOW, 'operator')]).toEqual([[], []]);
  });
});

describe('the question that the keys are about', () => {
  const [first, second] = [asked('first', 'high', 60), asked('second', 'low', 60)];

  it('stays the same while a more urgent one comes in', () => {
    expect(currentOf([first, second], 'second')).toBe('second');
  });

  it('is the most urgent one once it is answered', () => {
    expect(currentOf([first], 'second')).toBe('first');
    expect(currentOf([], 'second')).toBeNull();
  });
});

describe('the stage strip', () => {
  const states = (of: Partial<Invocation>, log: LogEvent[] = []): string =>
    stagesOf(invocation(of), log).map((stage) => `${stage.name} ${stage.state}`).join(', ');
  const note = (name: string, of: Partial<Invocation>, log: LogEvent[] = []): string | undefined =>
    stagesOf(invocation(of), log).find((stage) => stage.name === name)?.note;

  it('stands at the decision while a person is asked', () => {
    expect(states({ status: 'awaiting_approval' })).toBe('Goal done, Proposal done, Decision asks, Launch open, Watch open, Recover open, Outcome open');
  });

  it('says for whom it waits: for whoever looks, for one more after them, or for a person', () => {
    const open = escalation({ needed: 2, approvals: [{ by: 'ann', at: '', digest: '' }] });
    const of = (name: string, role: string): string => askedOf(open, { name, role });
    expect([of('bob', 'operator'), of('ann', 'operator'), of('eve', 'auditor')]).toEqual(['waits for you', 'needs 1 more', 'asks a person']);
    expect(askedOf(null, null)).toBe('waits for you');
    const notes = stagesOf(invocation({ status: 'awaiting_approval' }), [], 'asks a person').map((stage) => stage.note);
    expect(notes).toContain('asks a person');
  });

  it('stands at watching while a phase waits to be confirmed, and at recovering while a robot in trouble does', () => {
    const asks = (phase: string | null): LogEvent[] => [event('escalation', { escalation: { status: 'pending', phase } })];
    expect(states({ status: 'escalated' }, asks('settle'))).toContain('Watch asks, Recover open');
    expect(states({ status: 'escalated' }, asks(null))).toContain('Watch done, Recover asks');
  });

  it('stands at watching while it runs, and counts what policy cut', () => {
    expect(states({ status: 'running' })).toContain('Launch done, Watch now, Recover open');
    expect(note('Decision', { status: 'running' })).toBe('2 values cut');
    const { policy } = invocation();
    const changes = (requested: number | null): Invocation['policy'] => policy && { ...policy, changes: [{ param: 'clearance_m', requested, effective: 0.3, rule: 'clearance' }] };
    expect([0.2, null, 0.4].map((asked) => note('Decision', { policy: changes(asked) }))).toEqual(['1 changed', '1 changed', '1 value cut']);
  });

  it('shows a person’s own pause as a pause, and the watcher’s as trouble', () => {
    const log = [event('alert', { signal: 'VIOLATION' })];
    const at = (...by: string[]): string | undefined => stagesOf(invocation({ status: 'paused' }), log, '', holdersOf(cell({ status: 'paused', session: heldBy(...by) }))).find((stage) => stage.name === 'Watch')?.state;
    expect([at('operator'), at('watch'), at('operator', 'watch'), at()]).toEqual(['held', 'bad', 'bad', 'bad']);
    expect(states({ status: 'paused' })).toContain('Watch held');
  });

  it('says that a person drives what runs', () => {
    expect(stagesOf(invocation({ status: 'running' }), [], '', undefined, true).find((stage) => stage.name === 'Watch')?.note).toBe('driven by hand');
  });

  it('leaves nothing open of a proposal that is over', () => {
    const over = 'Launch skipped, Watch skipped, Recover skipped, Outcome bad';
    expect(states({ status: 'denied', outcome: 'denied' })).toContain(over);
    expect(note('Launch', { status: 'denied', outcome: 'expired' })).toBe('not launched');
    expect(['denied', 'expired', 'cancelled', 'stopped'].map((outcome) => note('Decision', { status: 'denied', outcome }))).toEqual(['denied', 'expired', 'cancelled', 'stopped']);
    expect(states({ status: 'denied', outcome: 'cancelled' })).toContain('Decision skipped, Launch skipped');
    const held = [event('launch', {}), event('intervention', { intervention: 'ESCALATE' })];
    expect(note('Recover', { status: 'failed', outcome: 'terminated' }, held)).toBe('ended instead');
    expect(note('Recover', { status: 'failed', outcome: 'terminated' }, held.slice(0, 1))).toBe('not needed');
  });

  it('counts violations of this session only', () => {
    const log = [event('alert', { signal: 'VIOLATION' }), event('alert', { signal: 'WARNING' }), event('alert', { signal: 'VIOLATION' }, 'inv_other')];
    expect(note('Watch', { status: 'paused' }, log)).toBe('1 violation');
  });

  it('stands at recovery when a held session asks', () => {
    expect(states({ status: 'escalated' })).toContain('Recover asks');
  });

  it('shows where a refused proposal ended', () => {
    expect(states({ status: 'rejected', outcome: 'rejected', policy: null, admission: { outcome: 'reject', reasons: [] } })).toContain('Proposal bad, Decision skipped, Launch skipped');
    expect(note('Decision', { status: 'denied', outcome: 'expired' })).toBe('expired');
    expect(states({ status: 'failed', outcome: 'fault' }, [event('launch', { refused: 'signature' })])).toContain('Launch bad');
  });

  it('ends with what it came to', () => {
    expect(states({ status: 'completed', outcome: 'recovered' }, [event('recovery', { strategy: 'RETRY' })])).toContain('Recover done, Outcome done');
    const handed = [event('human', { op: 'takeover', role: 'operator' }, 'inv_1', 'ann')];
    const again = (log: LogEvent[]): (string | undefined)[] => ['Recover', 'Outcome'].map((name) => note(name, { status: 'completed', outcome: 'recovered' }, log));
    expect([again(handed), again([])]).toEqual([['by hand', 'done on a new attempt'], ['new attempt', 'done on a new attempt']]);
    expect(states({ status: 'failed', outcome: 'stopped' })).toContain('Recover skipped, Outcome bad');
  });
});

describe('a gauge', () => {
  const least: GaugeSpec = { key: 's', label: '', unit: 'm', source: 'a', limit: 'b', side: 'least', span: 1 };
  const most: GaugeSpec = { ...least, side: 'most' };
  const names = ['b', 'a'];

  it('is beyond its limit as the watcher counts it', () => {
    expect(readGauge(least, names, [1.02, 1.01]).beyond).toBe(true);
    expect(readGauge(most, names, [0.25, 0.26]).beyond).toBe(false);
    expect(readGauge(most, names, [0.25, 0.263]).beyond).toBe(true);
  });

  it('is there for both speeds while somebody drives by hand, whatever ran before', () => {
    const labels = (capability: string | null, byHand: boolean): string[] => gaugesFor(capability === null ? null : invocation({ capability }), byHand).map((spec) => spec.label);
    for (const capability of ['takeover', 'grasp_object', null]) expect(labels(capability, true)).toEqual(['Separation', 'Base speed', 'Tool speed', 'Grip force', 'Contact force']);
    expect([labels('navigate_to', false)[1], labels('grasp_object', false)[1]]).toEqual(['Base speed', 'Tool speed']);
  });

  it('claims no progress of all of what was not done', () => {
    const progress = gaugesFor(null, false).find((spec) => spec.key === 'progress') ?? least;
    const shown = (status: Invocation['status'], value: number, spec = progress): number | null => unfinished(spec, { value, limit: null, beyond: false, near: false }, invocation({ status })).value;
    expect([shown('failed', 1), shown('escalated', 1), shown('failed', 0.4), shown('completed', 1), shown('running', 1), shown('failed', 1, least)]).toEqual([null, null, 0.4, 1, 1, 1]);
  });

  it('claims nothing where something is not known', () => {
    expect(readGauge(least, names, [NaN, 0.2])).toEqual({ value: expect.closeTo(0.2) as number, limit: null, beyond: false, near: false });
    expect(readGauge(least, ['b'], [1]).value).toBeNull();
    const near = (people_count: number, online = true): (string | null)[] => gaugesFor(null, false).map((spec) => noneOf(spec, cell({ online, facts: { people_count } })));
    expect([near(0)[0], near(0)[1], near(1)[0], near(0, false)[0], noneOf(gaugesFor(null, false)[0] ?? least, null)]).toEqual(['nobody seen', null, null, null, null]);
  });
});

describe('the history of a gauge', () => {
  it('keeps its window and thins what comes too fast', () => {
    const history = new History(1, 0.1);
    for (let k = 0; k <= 300; k += 1) history.push(k / 100, k, null);
    expect(history.times.length).toBeLessThanOrEqual(11);
    expect(history.times[0]).toBeGreaterThanOrEqual(1.9);
  });

  it('leaves out what lies between two points that are far apart', () => {
    const history = new History(30, 0.1);
    for (const atS of [1, 1.5, 2.4, 8.4, 8.6]) history.push(atS, atS, 10);
    expect(history.times).toEqual([1, 1.5, 2.4, 2.5, 8.4, 8.6]);
    expect(history.values).toEqual([1, 1.5, 2.4, null, 8.4, 8.6]);
    expect(history.limits).toEqual([10, 10, 10, null, 10, 10]);
  });

  it('begins anew when the clock goes back', () => {
    const history = new History(10, 0.1);
    history.push(100, 1, null);
    history.push(5, 2, null);
    expect(history.values).toEqual([2]);
  });
});

describe('trouble in the scene', () => {
  const near = { separationM: 0.84, neededM: 1.02, zoneMarginM: 1 };

  it('is a person nearer than the protective separation', () => {
    expect(troubleOf(cell({ status: 'paused' }), near, scene).words).toEqual({ strong: '0.84 m', text: 'to a person. Robot needs 1.02 m and has stopped moving.', brief: 'to a person, needs 1.02 m. Stopped.' });
    expect(troubleOf(cell({}), { ...near, separationM: 1.02 }, scene).separation).toBe(false);
  });

  it('says of a robot that the watcher holds that it goes on by itself, or waits for Resume', () => {
    const words = (...by: string[]): string => troubleOf(cell({ status: 'paused', session: heldBy(...by) }), near, scene).words?.text ?? '';
    expect(words('watch')).toMatch(/has stopped moving\. It goes on by itself once they have left, unless somebody pauses it\.$/);
    expect(words('operator', 'watch')).toMatch(/has stopped moving\. It waits for Resume, also once they have left\.$/);
  });

  it('is not claimed from what is not known', () => {
    expect(troubleOf(cell({}), { separationM: 0.1, neededM: null, zoneMarginM: null }, scene).words).toBeNull();
  });

  it('names the zone the robot cannot stop outside of', () => {
    const inside = cell({ facts: { base: [5, 1, 0] } });
    expect([...troubleOf(inside, { ...near, separationM: 3, zoneMarginM: -0.1 }, scene).zones]).toEqual(['press_area']);
    expect(zonesAt(scene, 1, 1)).toEqual([]);
  });
});

describe('the controls of a cell', () => {
  const control = { lease: 'lease_1', holder: 'ann', where: 'remote', since: '', invocation: 'inv_1', phase: 'held' } as const;

  it('are in the hands of the window that took them, and in nobody else’s', () => {
    expect(handsOn(cell({ control: null }), 'ann', 'lease_1')).toBe('free');
    expect(handsOn(cell({ control }), 'ann', 'lease_1')).toBe('here');
    expect(handsOn(cell({ control }), 'ann', 'lease_0')).toBe('elsewhere');
    expect(handsOn(cell({ control }), 'ann', null)).toBe('elsewhere');
    expect(handsOn(cell({ control }), 'bob', 'lease_1')).toBe('other');
    // What was asked for is seen for a moment although it is refused: a refusal that came meanwhile stays.
    const standing = (me: string, lease: string | null): string | null => standingLease(cell({ control }), handsOn(cell({ control }), me, lease));
    expect([standing('ann', null), standing('ann', 'lease_1'), standing('bob', null), standingLease(cell({ control: null }), 'free')]).toEqual([null, 'lease_1', 'lease_1', null]);
  });

  it('were refused of what is over once its session is, or where none ran, once one does that is nobody’s hand', () => {
    const over = (ran: string | null, busy: string | null, by: typeof control | null = null): boolean => isPast(ran, cell({ busy, control: by }));
    expect([over('inv_1', 'inv_1'), over('inv_1', 'inv_1', control), over(null, null), over(null, 'inv_2', control)]).toEqual([false, false, false, false]);
    expect([over('inv_1', null), over('inv_1', 'inv_2'), over('inv_1', 'inv_2', control), over(null, 'inv_2')]).toEqual([true, true, true, true]);
  });

  it('are lost where the log says so of their lease', () => {
    const lapsed = event('human', { op: 'control_lapsed', cell: 'workcell-1', holder: 'ann', lease: 'lease_1' });
    expect(lossOf([lapsed], 'lease_1')).toContain('for three seconds');
    expect(lossOf([{ ...lapsed, body: { ...lapsed.body, op: 'control_withdrawn' } }], 'lease_1')).toContain('lets nobody drive');
    expect([lossOf([lapsed], 'lease_0'), lossOf([lapsed], null)]).toEqual([null, null]);
    expect(lossOf([event('human', { op: 'release', lease: 'lease_1' })], 'lease_1')).toBe(null);
  });

  it('are lost, too, where the session they were for ended, or was made to wait, whatever did that', () => {
    const taken = (lease = 'lease_1'): LogEvent => event('human', { op: 'takeover', how: 'granted', lease }, 'inv_1', 'ann');
    const over = (code: string, name = 'inv_1'): LogEvent => event('outcome', { outcome: 'taken_over', code }, name);
    const waits = event('escalation', { reason: 'control_lapsed', failure: 'taken_over' });
    const asked = event('escalation', { escalation: { id: 'esc_1', status: 'withdrawn' } });
    expect(lossOf([taken(), over('link')], 'lease_1')).toContain('The cell had lost the server');
    expect(lossOf([taken(), event('human', { op: 'stop', role: 'operator' }, 'inv_1', 'bob'), over('operator')], 'lease_1')).toBe('bob ended what was driven.');
    expect(lossOf([taken(), over('journal_unavailable')], 'lease_1')).toBe('What you drove is over: journal unavailable.');
    expect(lossOf([taken(), waits], 'lease_1')).toBe('The robot came to rest, and the session waits for a person.');
    expect(lossOf([taken(), event('intervention', { intervention: 'ESCALATE', former: 'sha256:1' }), waits], 'lease_1')).toContain('Another policy came into force');
    expect(lossOf([taken(), event('intervention', { intervention: 'CONTINUE', former: 'sha256:1' }), waits], 'lease_1')).toBe('The robot came to rest, and the session waits for a person.');
    const [released, kept] = [event('human', { op: 'release', lease: 'lease_1' }), event('launch', { refused: 'no_plan' })];
    const launched = event('launch', { permit: 'auth_1' });
    expect(lossOf([taken(), launched, released, kept, over('link')], 'lease_1')).toContain('The cell had lost the server');
    expect(lossOf([taken(), kept], 'lease_1')).toBe('The cell did not let itself be driven.');
    const untold = [[taken(), launched, released, launched, over('link')], [taken(), asked], [taken(), over('estop')], [taken(), over('link', 'inv_2')], [over('link'), taken()], [taken(), event('human', { op: 'release', lease: 'lease_1' }), over('operator')], [taken(), taken('lease_2'), over('link')]];
    expect(untold.map((log) => lossOf(log, 'lease_1'))).toEqual(untold.map(() => null));
    expect([lossOf([taken(), over('link')], 'lease_0'), lossOf([over('link')], 'lease_1')]).toEqual([null, null]);
  });

  it('name who paused what one drives: the newest word of a person, not what its cell echoes', () => {
    const word = (by: string, name = 'inv_1'): LogEvent => event('human', { op: 'pause', role: 'operator' }, name, by);
    const log = [word('bob'), word('ann'), word('eve', 'inv_2'), event('human', { op: 'pause', done: true, refused: null, actor: 'ann' })];
    expect([pauserOf(log, 'inv_1'), pauserOf([], 'inv_1')]).toEqual(['ann', null]);
    expect(pausedWords(cell({ status: 'paused', session: heldBy('operator') }), 'ann')).toEqual({ why: 'ann paused the session', resumable: true });
  });

  it('name whose pause ended when they were taken, and none that was lifted before, or was the watcher’s', () => {
    const word = (op: string, by: string, more: object = {}): LogEvent => event('human', { op, role: 'operator', ...more }, 'inv_1', by);
    const taken = (status: string, how = 'granted'): LogEvent => word('takeover', 'ann', { status, how, lease: 'lease_1' });
    const ended = (...log: LogEvent[]): string | null => pauseEndedOf(log, control);
    expect(ended(word('pause', 'bob'), taken('paused'))).toBe('bob');
    expect(ended(word('pause', 'bob'), word('resume', 'ann'), taken('paused'))).toBeNull();
    expect(ended(word('pause', 'bob'), taken('running'))).toBeNull();
    expect(ended(word('pause', 'bob'), taken('paused', 'preempted'))).toBeNull();
    expect([ended(taken('paused')), ended(word('pause', 'bob')), pauseEndedOf([], null)]).toEqual([null, null, null]);
  });

  it('reach nothing while the link is down, or the cell is not heard', () => {
    expect(unreachedWords({ live: false, cell: cell() })).toBe('the link is down or too slow');
    expect(unreachedWords({ live: true, cell: cell({ online: false }) })).toBe('workcell-1 is not heard');
    expect(unreachedWords({ live: true, cell: cell() })).toBeNull();
  });

  it('say in words why they are not obeyed, and name a rule without any', () => {
    expect(refusalWords('release_first')).toBe('let go of everything, then press again');
    expect(refusalWords('human-shared/separation')).toBe('a person is too near');
    expect(refusalWords('people')).toBe('a person is too near');
    expect(refusalWords('human-shared/base-speed')).toBe('stopped by base-speed');
  });
});

describe('a session', () => {
  const may = (status: string, ...by: string[]): string => {
    const { pausable, resumable } = restraintsOf(status, holdersOf(cell({ status, session: heldBy(...by) })));
    return [pausable ? 'pause' : '', resumable ? 'resume' : ''].join(' ').trim();
  };

  it.each([
    ['running', [], 'pause'],
    ['recovering', [], 'pause'],
    ['paused', ['watch'], 'pause'],
    ['paused', ['operator'], 'resume'],
    ['paused', ['operator', 'watch'], 'resume'],
    ['paused', [], 'pause'],
    ['escalated', [], ''],
  ])('that is %s by %j may be told to: %s', (status, by, words) => {
    expect(may(status, ...by)).toBe(words);
  });
});

describe('letting a held session go on', () => {
  const asks = (code: string): Escalation => escalation({ kind: 'session', reasons: [{ rule: 'runtime/session', code, message: '', remedy: '' }] });
  const near = (busy = 'inv_1', ...violated: string[]): ReturnType<typeof cell> => cell({ busy, status: 'escalated', session: { ...heldBy(), violated } });
  const paused = event('intervention', { intervention: 'PAUSE', rule: 'separation' });

  it.each(['separation', 'people', 'protective-separation'])('says that it waits as long as somebody is too near, and asks again (%s)', (rule) => {
    expect(goingOn(asks(rule), near('inv_1', rule), [])).toEqual({ yes: 'Go on once they have left', note: expect.stringMatching(/^(?!.*\byou\b).*asks again if they stay/) as string }); // whoever may only look reads it, too
    expect(goingOn(asks('separation'), near('inv_1', 'zone'), [])).toEqual({ yes: 'Let it go on', note: null });
    expect(goingOn(asks('separation'), near('inv_2', 'separation'), []).yes).toBe('Let it go on');
    expect(goingOn(asks('separation'), null, []).note).toBeNull();
  });

  it('promises no wait that the session has not shown', () => {
    expect(goingOn(asks('confirm'), near('inv_1', 'separation'), [])).toEqual({ yes: 'Let it go on', note: 'A person is too near now.' });
    expect(goingOn(asks('confirm'), near('inv_1', 'separation'), [paused]).note).toMatch(/waits until they have left\.$/);
  });

  it('leaves the rollback to the answer where that is what a denial means', () => {
    const held = escalation({ kind: 'session', on_deny: 'rollback' });
    expect(deniedIsUndone([held], 'inv_1')).toBe(true);
    expect(deniedIsUndone([held], 'inv_2')).toBe(false);
    expect(deniedIsUndone([{ ...held, on_deny: 'terminate' }, { ...held, kind: 'approval' }], 'inv_1')).toBe(false);
  });
});

describe('why a held session asks', () => {
  const reason = { rule: 'runtime/session', message: 'it could not be undone and verified (`rollback_failed`); the session is held and waits for a human', remedy: 'let it go on with a new attempt, or end it' };

  it('says what a person may do about it', () => {
    const held = escalation({ kind: 'session', reasons: [{ ...reason, code: 'rollback_failed' }] });
    expect(reasonLines(held, null)[0]).toMatchObject({ strong: 'It could not be undone and verified.', text: 'The robot holds where it is and waits. Let it go on with a new attempt, or end it.' });
  });

  it.each(['separation', 'people'])('is somebody too near, by either name of the rule (%s)', (code) => {
    const near = escalation({ kind: 'session', reasons: [{ ...reason, code }] });
    expect(reasonLines(near, null)[0]).toMatchObject({ icon: 'person', strong: 'A person stayed inside the protective distance, or at its edge.', text: 'The robot holds where it is and waits. Let it go on with a new attempt, or end it.' });
  });

  it('is a rollback that cannot be had, in words', () => {
    const held = escalation({ kind: 'session', reasons: [{ ...reason, code: 'rollback_unavailable' }] });
    expect(reasonLines(held, null)[0]?.strong).toBe('It cannot be rolled back: there is nothing to go back to, or it was tried already.');
  });

  it('names a force by the limit it falls under', () => {
    const said = { ...reason, code: 'x', message: '`force_n` is over', remedy: '' };
    expect(reasonLines(escalation({ reasons: [said] }), null, { force_n: { 'x-limit': 'contact_force_n' } })[0]?.text).toBe('Contact force is over.');
  });

  it('says once what two cuts of one rule come to in the same words', () => {
    const cut = (name: string) => ({ ...reason, code: 'limit', rule: 'own/grip', message: `\`${name}\` lowered to 20 N (limit of ${name})` });
    const inputs = { force_n: { 'x-limit': 'grip_force_n' }, grip_force_n: { 'x-limit': 'grip_force_n' } };
    expect(reasonLines(escalation({ reasons: [cut('force_n'), cut('grip_force_n')] }), null, inputs)).toHaveLength(1);
  });

  it('has what a rule says in brackets, but where the number of a limit is from', () => {
    const said = (code: string) => reasonLines(escalation({ reasons: [{ ...reason, code, message: 'ask first (the plate is at 80 °C)', remedy: '' }] }), null)[0]?.text;
    expect([said('hot'), said('limit')]).toEqual(['Ask first (the plate is at 80 °C).', 'Ask first.']);
  });

  it('is not told what an agent is told of a proposal', () => {
    expect(reasonLines(escalation({ reasons: [{ ...reason, code: 'x', message: 'why', remedy: 'wait' }] }), null)[0]?.text).toBe('Why.');
  });
});
