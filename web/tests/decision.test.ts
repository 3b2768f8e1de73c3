import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import { ApiError, type Answer } from '../src/lib/api/client';
import type { Escalation, List, LogEvent, Params, Verdict } from '../src/lib/api/documents';
import { checkEdit, checkOf, mayApprove, readEdit, rowsOf } from '../src/lib/live/edit';
import { ARM_MS } from '../src/lib/keys/arming.svelte';
import { restrains, standingDenial, unsaid } from '../src/lib/live/denials';
import { another, coverOf } from '../src/lib/live/grants';
import { Decision } from '../src/lib/live/decision.svelte';
import { escalation, event, invocation } from './samples';

const SCHEMA = { force_n: { minimum: 2, maximum: 140 }, speed_mps: { minimum: 0.02, maximum: 2 } };
const EFFECTIVE = escalation().effective;

const events = (): Promise<List<LogEvent>> => Promise.resolve({ items: [], next: null });

function verdict(of: Partial<Verdict>): Verdict {
  return { ...invocation(), status: 'awaiting_approval', ...of };
}

describe('what was typed', () => {
  it('is an edit only where it differs from what is asked', () => {
    expect(readEdit({ force_n: '60', speed_mps: '0.1' }, EFFECTIVE, SCHEMA).params).toEqual({ speed_mps: 0.1 });
  });

  it('may use a decimal comma', () => {
    expect(readEdit({ speed_mps: '0,1' }, EFFECTIVE, SCHEMA).params).toEqual({ speed_mps: 0.1 });
  });

  it.each(['', 'fast', '1e9', '0x10', 'NaN', 'Infinity', '--1'])('is refused when it is no plain number: %j', (text) => {
    expect(readEdit({ speed_mps: text }, EFFECTIVE, SCHEMA)).toEqual({ params: {}, faults: { speed_mps: 'a number, please' } });
  });

  it('is refused outside the schema', () => {
    expect(readEdit({ speed_mps: '2.5', force_n: '1' }, EFFECTIVE, SCHEMA).faults).toEqual({ speed_mps: 'at most 2, whatever policy allows', force_n: 'at least 2, whatever policy allows' });
  });
});

describe('the rows', () => {
  it('stand in the same order wherever the document comes from', () => {
    const asked = escalation();
    const turned = { ...asked, effective: Object.fromEntries(Object.entries(asked.effective).reverse()), requested: {} };
    const names = (of: Escalation): string[] => rowsOf(of, ['object_id', 'speed_mps', 'force_n']).map((row) => row.name);
    expect([names(asked), names(turned)]).toEqual([['speed_mps', 'force_n', 'object_id'], ['speed_mps', 'force_n', 'object_id']]);
  });

  it('offer numbers of a proposal for editing, and nothing of a session under way', () => {
    expect(rowsOf(escalation()).filter((row) => row.editable).map((row) => row.name)).toEqual(['force_n', 'speed_mps']);
    expect(rowsOf(escalation({ kind: 'session' })).some((row) => row.editable)).toBe(false);
  });
});

describe('what policy says to an edit', () => {
  const wanted: Params = { ...EFFECTIVE, speed_mps: 0.1 };

  it('is allowed where a person would be asked about exactly this', () => {
    expect(checkOf(verdict({ effective: wanted }), wanted)).toEqual({ is: 'allowed' });
  });

  it('names what policy cuts further', () => {
    expect(checkOf(verdict({ effective: { ...wanted, force_n: 20 } }), wanted)).toEqual({ is: 'cut', to: { force_n: 20 } });
  });

  it('cannot be approved where policy refuses it, or while it is not known', () => {
    const refused = checkOf(verdict({ status: 'denied' }), wanted);
    expect(refused.is).toBe('refused');
    expect([refused, { is: 'checking' } as const, { is: 'faulty' } as const].map(mayApprove)).toEqual([false, false, false]);
  });

  it('is asked under what the agent said with its proposal', async () => {
    const said = { mode: 'careful', metadata: { confidence: 0.4 }, preconditions: ['arm_ready'], recovery_preference: null, capability_version: '^1.0.0' };
    const proposed = event('proposal', { ...said, capability: 'grasp_object', params: { object_id: 'mug_1' }, cell: null, filled: {}, created_at: '' });
    const check = vi.fn(() => Promise.resolve(verdict({ effective: wanted })));
    const found = vi.fn(() => Promise.resolve({ items: [proposed], next: null }));
    expect(await checkEdit({ check, events: found }, escalation(), { speed_mps: 0.1 }, 'workcell-1')).toEqual({ is: 'allowed' });
    expect(String(found.mock.calls[0])).toBe('invocation=inv_1&kind=proposal');
    expect(check).toHaveBeenCalledWith({ ...said, capability: 'grasp_object', params: wanted, cell: 'workcell-1', agent: 'planner' });
  });
});

describe('a decision', () => {
  let sent: Answer[];
  let checks: ((verdict: Verdict) => void)[];
  let reply: () => Promise<Escalation>;

  beforeEach(() => {
    vi.useFakeTimers();
    sent = [];
    checks = [];
    reply = () => Promise.resolve(escalation({ status: 'approved' }));
  });
  afterEach(() => vi.useRealTimers());

  function decide(): Decision {
    return new Decision(
      {
        check: () => new Promise((resolve) => checks.push(resolve)),
        events,
        resolve: (_, answer) => {
          sent.push(answer);
          return reply();
        },
      },
      escalation(),
      () => ({ schema: SCHEMA, cell: 'workcell-1' }),
    );
  }

  it('approves what is shown, bound to its digest', async () => {
    await decide().approve();
    expect(sent).toEqual([{ decision: 'approve', digest: 'sha256:1' }]);
  });

  it('does not approve an edit before policy has allowed it', async () => {
    const decision = decide();
    decision.type('speed_mps', '0.1');
    await decision.approve();
    expect([sent.length, decision.check.is]).toEqual([0, 'checking']);
    await vi.advanceTimersByTimeAsync(300);
    checks[0]?.(verdict({ effective: { ...EFFECTIVE, speed_mps: 0.1 } }));
    await vi.advanceTimersByTimeAsync(0);
    await decision.approve();
    expect(sent).toEqual([{ decision: 'approve', digest: 'sha256:1', params: { speed_mps: 0.1 } }]);
  });

  it('goes on with what was typed on the card before, once policy has been asked about it again', async () => {
    const before = decide();
    expect(before.putDown()).toBeNull();
    before.type('speed_mps', '0.1');
    const after = decide();
    const draft = before.putDown();
    await vi.advanceTimersByTimeAsync(300);
    expect(checks).toEqual([]); // of a card that is gone nothing is asked
    if (draft !== null) after.takeUp(draft);
    expect([after.edit.params, after.check.is, after.ready, after.lost]).toEqual([{ speed_mps: 0.1 }, 'checking', false, '']);
    await vi.advanceTimersByTimeAsync(300);
    checks.at(-1)?.(verdict({ effective: { ...EFFECTIVE, speed_mps: 0.1 } }));
    await vi.advanceTimersByTimeAsync(0);
    await after.approve();
    expect(sent).toEqual([{ decision: 'approve', digest: 'sha256:1', params: { speed_mps: 0.1 } }]);
    expect(after.putDown()).toBeNull();
  });

  it('says of what was typed on the card before that it is gone, where another thing is asked by now', () => {
    const before = decide();
    before.type('speed_mps', 'fast');
    const after = new Decision({ check: vi.fn(), events, resolve: vi.fn() }, escalation({ digest: 'sha256:2' }), () => ({ schema: SCHEMA, cell: null }));
    const draft = before.putDown();
    if (draft !== null) after.takeUp(draft);
    expect([after.typed, after.lost, after.putDown()]).toEqual([{}, 'Your edit was of what was asked before: it was not sent, and is gone.', null]);
  });

  it('says why it approved nothing, and keeps no press for later', async () => {
    const decision = decide();
    decision.type('speed_mps', '0.1');
    const pressed = decision.shown;
    await decision.approve();
    expect(decision.withheld).toBe('Nothing was approved: your edit was still being checked. Press again once it is allowed.');
    await vi.advanceTimersByTimeAsync(300);
    checks[0]?.(verdict({ effective: { ...EFFECTIVE, speed_mps: 0.1 } }));
    await vi.advanceTimersByTimeAsync(0);
    expect([sent.length, decision.ready, decision.shown === pressed]).toEqual([0, true, false]);
    decision.withhold(); // what was pressed is not what was let go of
    expect(decision.withheld).toContain('changed while you pressed');
    decision.type('speed_mps', 'fast');
    expect(decision.withheld).toBe('');
    await decision.approve();
    expect([sent.length, decision.withheld]).toEqual([0, 'Nothing was approved: correct your edit first.']);
  });

  it('does not take the answer to an earlier edit for the answer to this one', async () => {
    const decision = decide();
    decision.type('speed_mps', '0.1');
    await vi.advanceTimersByTimeAsync(300);
    decision.type('speed_mps', '0.2');
    checks[0]?.(verdict({ effective: { ...EFFECTIVE, speed_mps: 0.1 } }));
    await vi.advanceTimersByTimeAsync(0);
    expect(decision.check.is).toBe('checking');
  });

  it('forgets an edit when the question has become another', () => {
    const decision = decide();
    decision.type('speed_mps', '0.1');
    decision.update(escalation({ digest: 'sha256:other' }));
    expect([decision.edited, decision.check.is]).toEqual([false, 'untouched']);
  });

  describe('of which an edit was in the making when the question became another', () => {
    const other = (speed: number): Escalation => escalation({ digest: 'sha256:other', effective: { ...EFFECTIVE, speed_mps: speed } });
    const UNSENT = 'Your edit was of what was asked before: it was not sent, and is gone.';
    const IN_VAIN = 'Your edit was of what was asked before: it does not count, and is gone.';
    const refusing = (code: string): (() => Promise<Escalation>) => () => Promise.reject(new ApiError({ title: '', status: 409, detail: 'x', code }));

    it.each(['0.1', 'x', ''])('says that it is gone, whole or not: %j', (text) => {
      const decision = decide();
      decision.type('speed_mps', text);
      decision.update(other(0.2));
      expect([decision.typed, decision.lost]).toEqual([{}, UNSENT]);
      decision.update({ ...other(0.2), acknowledged: [] });
      expect(decision.lost).toBe(UNSENT);
      decision.type('speed_mps', '0.1');
      expect(decision.lost).toBe('');
    });

    it('says nothing where nothing was typed, or what was typed is what is asked now', () => {
      const [untouched, same] = [decide(), decide()];
      untouched.update(other(0.2));
      same.type('speed_mps', '0.1');
      same.update(other(0.1));
      expect([untouched.lost, same.lost]).toEqual(['', '']);
    });

    async function approveEdit(decision: Decision): Promise<() => Promise<unknown>> {
      decision.type('speed_mps', '0.1');
      await vi.advanceTimersByTimeAsync(300);
      checks.at(-1)?.(verdict({ effective: { ...EFFECTIVE, speed_mps: 0.1 } }));
      await vi.advanceTimersByTimeAsync(0);
      const answered = decision.approve();
      return () => answered;
    }

    it('says nothing of one that was sent and taken, cut or not', async () => {
      reply = () => Promise.resolve(other(0.05));
      const decision = decide();
      const answered = await approveEdit(decision);
      decision.update(other(0.05));
      await answered();
      expect(decision.lost).toBe('');
    });

    it('says that one does not count that came too late, whichever is heard first', async () => {
      reply = refusing('digest_mismatch');
      const [before, after] = [decide(), decide()];
      const first = await approveEdit(before);
      before.update(other(0.2));
      await first();
      await (await approveEdit(after))();
      after.update(other(0.2));
      expect([before.lost, after.lost]).toEqual([IN_VAIN, IN_VAIN]);
    });

    it('does not say what became of one that may have arrived', async () => {
      reply = refusing('unreachable');
      const decision = decide();
      await (await approveEdit(decision))();
      decision.update(other(0.05));
      expect([decision.lost, decision.problem]).toEqual(['', 'X.']); // in the words of whoever sent it
    });
  });

  it('loses nothing that was typed while it was on its way, whatever policy gives back', async () => {
    const decision = decide();
    decision.type('force_n', '70');
    await vi.advanceTimersByTimeAsync(300);
    checks[0]?.(verdict({ effective: EFFECTIVE }));
    await vi.advanceTimersByTimeAsync(0);
    reply = () => Promise.resolve(escalation());
    const approval = decision.approve();
    decision.type('force_n', '40');
    await approval;
    expect([decision.typed, decision.check.is]).toEqual([{ force_n: '40' }, 'checking']);
  });

  it('takes the value policy gives back, and approves that once there was time to read it', async () => {
    const decision = decide();
    decision.type('force_n', '70');
    await vi.advanceTimersByTimeAsync(300);
    checks[0]?.(verdict({ effective: EFFECTIVE }));
    await vi.advanceTimersByTimeAsync(0);
    reply = () => Promise.resolve(escalation());
    await decision.approve();
    expect([decision.typed, decision.check]).toEqual([{}, { is: 'given back', to: { force_n: 60 }, read: false }]);
    await decision.approve();
    await vi.advanceTimersByTimeAsync(ARM_MS);
    await decision.approve();
    expect(sent).toEqual([
      { decision: 'approve', digest: 'sha256:1', params: { force_n: 70 } },
      { decision: 'approve', digest: 'sha256:1' },
    ]);
  });

  it('says that more is allowed with it', () => {
    const decision = decide();
    decision.offer = { scope: 'time', minutes: 15 };
    expect(decision.approves).toBe('Approve and allow for 15 min');
    decision.type('force_n', '40');
    expect(decision.approves).toBe('Approve edit and allow for 15 min');
    decision.offer = null;
    expect(decision.approves).toBe('Approve edit');
  });

  it('denies with a code, and with a half-typed edit as well', async () => {
    const decision = decide();
    decision.code = 'person_in_the_way';
    decision.type('speed_mps', 'x');
    await decision.deny();
    expect(sent).toEqual([{ decision: 'deny', digest: 'sha256:1', code: 'person_in_the_way' }]);
  });

  it('takes no second answer while the card of an answered question is still there', async () => {
    const decision = decide();
    await decision.approve();
    await decision.deny();
    expect([sent.length, decision.ready]).toEqual([1, false]);
  });

  it('is denied though an approval is on its way, which says nothing any more', async () => {
    const answers: { give: (of: Escalation) => void; fail: (code: string) => void }[] = [];
    reply = () => new Promise((give, fail) => answers.push({ give, fail: (code) => fail(new ApiError({ title: '', status: 409, detail: 'x', code })) }));
    const decision = decide();
    const approval = decision.approve();
    expect([decision.ready, decision.deniable]).toEqual([false, true]);
    const denial = decision.deny();
    expect([sent.map((one) => one.decision), decision.sending, decision.deniable]).toEqual([['approve', 'deny'], 'deny', false]);
    answers[1]?.give(escalation({ status: 'denied' }));
    await denial;
    answers[0]?.fail('already_resolved');
    await approval;
    expect([decision.problem, decision.late, decision.sending]).toEqual(['', false, 'deny']);
    const second = decide();
    const [first, refused] = [second.approve(), second.deny()];
    answers[2]?.give(escalation({ status: 'approved' }));
    await first;
    answers[3]?.fail('already_resolved');
    await refused;
    expect([second.problem, second.late]).toEqual(['Somebody has answered this already.', true]);
  });

  it('can be given again where one approval was not enough', async () => {
    reply = () => Promise.resolve(escalation({ digest: 'sha256:2' }));
    const decision = decide();
    await decision.approve();
    expect(decision.ready).toBe(true);
  });

  it('is sent once, and says in words why the server would not have it', async () => {
    reply = () => Promise.reject(new ApiError({ title: '', status: 409, detail: 'x', code: 'already_resolved' }));
    const decision = decide();
    const first = decision.deny();
    await decision.deny();
    await first;
    expect([sent.length, decision.problem]).toEqual([1, 'Somebody has answered this already.']);
  });
});

describe('the reason of a denial', () => {
  const [first, other] = ['unsafe', 'not_now'].map((code) => ({ code, says: code }));

  it('is one that the policy in force declares, or the denial would be refused', () => {
    expect(['', 'not_now', 'dropped'].map((code) => standingDenial(code, escalation(), [first, other].flatMap((one) => one ?? [])))).toEqual(['', 'not_now', '']);
    expect(standingDenial('not_now', escalation(), [])).toBe('not_now'); // where none is known, what was chosen stands
  });

  it('has to be said where there is more than one to choose from', () => {
    const both = [first, other].flatMap((one) => one ?? []);
    expect([unsaid('', both), unsaid('not_now', both), unsaid('', both.slice(1)), unsaid('', [])]).toEqual([true, false, false, false]);
  });

  it('restrains, unless what is denied is undone', () => {
    const endings = (['deny', 'terminate', 'rollback', undefined] as const).map((on_deny) => restrains(on_deny === undefined ? {} : { on_deny }));
    expect(endings).toEqual([true, true, false, true]);
  });
});

describe('what is offered in advance', () => {
  it('is of the object that is named beside it', () => {
    const of = { scope: 'object', minutes: 5, object: 'mug_1' } as const;
    expect([another(of, 'mug_1'), another(of, 'mug_2'), another(of, null), another({ scope: 'time', minutes: 5 }, null), another(null, 'mug_1')]).toEqual([false, true, true, false, false]);
  });
});

describe('what a standing grant covers', () => {
  const bound = { capability: 'grasp_object', agent: 'planner', cell: 'workcell-1', object: null, task: null };

  it('is said with capability, agent and cell, whatever its scope', () => {
    expect(coverOf({ ...bound, scope: 'time' })).toBe('every “grasp object” by planner in workcell-1');
    expect(coverOf({ ...bound, scope: 'object', object: 'mug_1' })).toBe('“grasp object” of mug_1 by planner in workcell-1');
    expect(coverOf({ ...bound, scope: 'task' })).toBe('“grasp object” for its task by planner in workcell-1');
  });

  it('is not turned around, or buried, by the name of a task', () => {
    expect(coverOf({ ...bound, scope: 'task', task: '\u05D0\u2069\u202E' })).toBe('“grasp object” for its task “\u2068\u05D0\uFFFD\uFFFD\u2069” by planner in workcell-1');
    expect(coverOf({ ...bound, scope: 'task', task: 'x'.repeat(5000) }).length).toBeLessThan(240);
  });
});
