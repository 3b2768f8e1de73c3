import { describe, expect, it } from 'vitest';
import type { Escalation, LogEvent } from '../src/lib/api/documents';
import { aboutOf, cellOf, entriesOf, eventLine, quietly, turnedAway, type Known } from '../src/lib/format/events';
import { changedWords, standingEdit, voidedOf } from '../src/lib/format/edited';
import { clockTime } from '../src/lib/format/time';
import { Keys } from '../src/lib/keys/keys';
import { cell, escalation, event, invocation } from './samples';

const DOCS = {
  cells: { 'workcell-1': cell(), 'workcell-2': cell({ id: 'workcell-2' }) },
  invocations: { inv_1: invocation({ cell: 'workcell-2' }) },
};

describe('where something happened', () => {
  it('is said by the event, or else by its session, or else by the cell that speaks', () => {
    expect(cellOf(event('human', { op: 'estop', cell: 'workcell-1' }, null, 'operator'), DOCS)).toBe('workcell-1');
    expect(cellOf(event('policy', { outcome: 'allow' }, 'inv_1', 'kernel'), DOCS)).toBe('workcell-2');
    expect(cellOf(event('cell', { what: 'estop' }, null, 'workcell-1'), DOCS)).toBe('workcell-1');
    expect(cellOf(event('boot', {}, null, 'server'), DOCS)).toBeNull();
  });

  it('keeps what two cells say alike apart', () => {
    const events = [event('cell', { link: 'attached' }, null, 'workcell-1'), event('cell', { link: 'attached' }, null, 'workcell-2')];
    const entries = entriesOf(events, 10, (one) => cellOf(one, DOCS));
    expect(entries.map((entry) => [entry.cell, entry.times])).toEqual([['workcell-2', 1], ['workcell-1', 1]]);
  });
});

describe('what a cell says of its stop', () => {
  it('names whom the cell names in the words of the cell', () => {
    const said = (body: LogEvent['body']): string => {
      const { strong, text } = eventLine(event('cell', body, null, 'workcell-1'));
      return strong + text;
    };
    expect(said({ what: 'estop', actor: 'ann', cell_seq: 4 })).toBe('Emergency stop obeyed, power off, by ann, says workcell-1');
    expect(said({ what: 'estop', cell_seq: 4 })).toBe('Emergency stop obeyed, power off, by workcell-1');
    expect(said({ what: 'reset', actor: 'ann', cell_seq: 5 })).toBe('Reset, nothing moved, by ann, says workcell-1');
  });
});

describe('what is said of telemetry', () => {
  const said = (body: LogEvent['body']): [string, string] => {
    const { tone, strong, text } = eventLine(event('telemetry', body, 'inv_1', 'server'));
    return [tone, strong + text];
  };

  it('is that it was kept only where the record says so, and what is missing of it', () => {
    expect(said({ file: 'inv_1.mcap', rows: 12 })).toEqual(['quiet', 'Telemetry kept, 12 rows']);
    expect(said({ failed: 'no room is left on the disk' })).toEqual(['warn', 'Telemetry not kept: no room is left on the disk']);
    expect(said({ file: 'inv_1.mcap', rows: 12, missing: 'the cell was lost' })).toEqual(['warn', 'Telemetry kept, 12 rows, not whole: the cell was lost']);
  });

  it('is among the main lines of the log where it was not kept, or not whole', () => {
    const left = [{ file: 'inv_1.mcap', rows: 12 }, { failed: 'no room' }, { rows: 12, missing: 'the cell was lost' }].map((body) => quietly(event('telemetry', body)));
    expect(left).toEqual([true, false, false]);
    expect([quietly(event('status', { status: 'failed' })), quietly(event('alert', {}))]).toEqual([true, false]);
  });
});

describe('what a line is about', () => {
  const proposed = event('proposal', { capability: 'grasp_object', params: { object_id: 'glass_1' } }, 'inv_2');
  const docs = { invocations: { inv_1: invocation() }, events: [proposed] };

  it('is the title of the session, or of the proposal where that is all there is', () => {
    const about = (kind: string, name: string | null): string | null => aboutOf(event(kind, {}, name), docs);
    expect([about('outcome', 'inv_1'), about('approval', 'inv_2')]).toEqual(['Grasp mug_1', 'Grasp glass_1']);
    expect([about('outcome', 'inv_3'), about('cell', null), aboutOf(proposed, docs)]).toEqual([null, null, null]);
    const entries = entriesOf([proposed, event('outcome', { outcome: 'expired' })], 10, undefined, undefined, (one) => aboutOf(one, docs));
    expect(entries.map(({ about: of }) => of)).toEqual(['Grasp mug_1', null]);
  });
});

describe('a standing grant', () => {
  const said = (op: string, grant: Record<string, string | Record<string, string> | null>): string => {
    const line = eventLine(event('grant', { op, grant: { capability: 'grasp_object', object: 'glass_1', task: null, ...grant } }, null, 'ann'));
    return `${line.strong}${line.text}`;
  };
  it('says what it is for, and why it ended', () => {
    expect(said('given', { ended: null })).toBe('ann opened a standing grant: grasp object glass_1');
    expect(said('ended', { ended: { code: 'revoked', by: 'bob' } })).toBe('bob revoked a standing grant: grasp object glass_1');
    expect(said('ended', { ended: { code: 'expired', by: 'server' } })).toBe('Standing grant ran out: grasp object glass_1');
    expect(said('ended', { ended: { code: 'giver_withdrawn', by: 'server' } })).toBe('Standing grant ended with the token of who gave it: grasp object glass_1');
    expect(said('ended', { object: null, ended: { code: 'another', by: 'server' } })).toBe('Standing grant ended: grasp object');
  });
});

const said = (one: LogEvent, known?: Known): string => {
  const { strong, text } = eventLine(one, known);
  return `${strong}${text}`;
};
const FORCE: Known = { inputs: () => ({ force_n: { 'x-limit': 'contact_force_n' } }), grant: () => null, turnedAway: () => false };

describe('what a person orders', () => {
  it('is told as ordered, and by the cell as obeyed, or not and why', () => {
    expect(said(event('human', { op: 'rollback', role: 'operator' }, 'inv_1', 'ann'))).toBe('ann ordered a rollback');
    const echo = (op: string, refused: string | null): string => said(event('human', { op, done: refused === null, refused, actor: 'ann' }));
    expect(echo('pause', null)).toBe('workcell-1 obeys: pause');
    expect(echo('rollback', 'rollback_unavailable')).toBe('workcell-1 does not obey: rollback, there is nothing to go back to, or it was tried already');
    expect(echo('resume', 'new_code')).toBe('workcell-1 does not obey: resume, new code');
    expect(echo('jog', 'blocked')).toBe('workcell-1 does not obey: drive by hand, the base has met something');
    expect(echo('let_go', null)).toBe('workcell-1 is at rest again');
    expect(echo('let_go', 'not_taken_over')).toBe('workcell-1 was let go of already');
  });

  it('is told of what a hand asks for, and which way', () => {
    const asked = (more: LogEvent['body']): string => said(event('human', { op: 'jog', n: 3, done: true, refused: null, base: [0, 0, 0], tool: [0, 0, 0], grip: null, ...more }));
    expect(asked({ base: [0.3, -0.4, 0] })).toBe('workcell-1 is driven by hand: base forward and right 0.50 m/s');
    expect(asked({ base: [0, 0, 0.2], tool: [-0.02, 0, 0.01], grip: 'open' })).toBe('workcell-1 is driven by hand: turn left 0.20 rad/s, tool back and up 0.02 m/s, open the gripper');
    expect([asked({}), asked({ base: null, tool: 'x', grip: 3 })]).toEqual(['workcell-1 is let go of', 'workcell-1 is let go of']);
  });

  it('is told of where a rollback failed', () => {
    expect(said(event('recovery', { failure: 'rollback_failed', strategy: 'ESCALATE', capability: null }))).toBe('It could not be undone and verified: escalate');
    const left = { failure: 'rollback_failed', strategy: 'ASK_HUMAN', capability: null, unmet: ['base_pose', 'tool_state', 'arm_retracted'] };
    expect(said(event('recovery', left))).toBe('It could not be undone and verified (the base stands elsewhere; the tool is not as it was; arm retracted): ask human');
    expect(said(event('outcome', { outcome: 'terminated', code: 'rollback_failed' }))).toBe('Terminated, rollback failed');
    expect(said(event('outcome', { outcome: 'taken_over', code: 'link' }))).toBe('Taken over, ended, as the cell had lost the server');
    expect(said(event('outcome', { outcome: 'taken_over', code: 'operator' }))).toBe('Taken over');
    expect(said(event('outcome', { outcome: 'fault', code: 'journal_unavailable', failure: null }))).toMatch(/, the cell could not write its journal$/);
    expect(said(event('outcome', { outcome: 'stopped', code: 'estop' }))).toMatch(/, by an emergency stop$/);
  });
});

describe('a verdict of policy', () => {
  const cut = (rule: string): LogEvent => event('policy', { outcome: 'modify', changes: [{ param: 'force_n', requested: 280, effective: 100, rule }] });

  it('names a force by the limit it falls under', () => {
    expect(said(cut('organization/press'), FORCE)).toBe('Contact force 280 → 100');
    expect(said(cut('human-shared/contact_force_n'))).toBe('Contact force 280 → 100');
    expect(said(cut('human-shared/grip_force_n'))).toBe('Grip force 280 → 100');
  });

  it('says of a proposal that was checked again that it is still allowed, or what that changed', () => {
    const again = (changes: object[]): string => said(event('policy', { outcome: 'allow', recheck: true, changes: changes as never }));
    expect(again([])).toBe('Checked again: still allowed');
    expect(again([{ param: 'speed_mps', requested: 0.5, effective: 0.25, rule: 'r' }])).toBe('Checked again: Speed 0.50 → 0.25');
    expect(said(event('policy', { outcome: 'allow', changes: [] }))).toBe('Allowed as proposed');
  });

  it('says of who takes a session over that it is about their driving', () => {
    const taking = { takeover: true, outcome: 'modify', changes: [{ param: 'tcp_speed_mps', requested: 0.5, effective: 0.25, rule: 'r' }] };
    expect(said(event('admission', { takeover: true, outcome: 'accept', reasons: [] }))).toBe('Driving by hand admitted');
    expect(said(event('policy', { takeover: true, outcome: 'allow', changes: [] }))).toBe('Driving by hand allowed');
    expect(said(event('policy', taking as never))).toBe('Driving by hand: Tool speed 0.50 → 0.25');
  });

  it('says of a hand-back that was refused whose it was, and what people are asked about', () => {
    const refused = { reasons: [{ message: 'Somebody looks.' }, { message: 'medium risk needs approval in `human-shared`' }] };
    const told = event('policy', { outcome: 'allow', recheck: true, changes: [], hand_back: { by: 'ann', refused } });
    expect(said(told)).toBe('ann cannot hand back yet: Somebody looks; medium risk needs approval in human-shared');
  });

  it('says of a proposal that was turned away what policy would say, and not that it is allowed', () => {
    const verdict = (outcome: string, changes: object[] = []): LogEvent => event('policy', { outcome, changes: changes as never });
    const away = { ...FORCE, turnedAway: () => true };
    expect(said(verdict('allow'), away)).toBe('Policy alone would allow it');
    expect(said(verdict('modify', [{ param: 'force_n', requested: 280, effective: 100, rule: 'r' }]), away)).toBe('Policy alone would change it: Contact force 280 → 100');
    expect(said(verdict('escalate'), away)).toBe('Policy would ask a person');
    expect(said(verdict('deny'), away)).toContain('Denied by policy');
    const [put, letIn] = [event('admission', { outcome: 'defer' }), event('admission', { outcome: 'accept', recheck: true })];
    expect([turnedAway([put], verdict('allow')), turnedAway([put, letIn], verdict('allow')), turnedAway([], verdict('allow'))]).toEqual([true, false, false]);
  });

  it('names the standing grant that answered in the place of a person', () => {
    const grant = (id: string): ReturnType<Known['grant']> => (id === 'grant_1' ? { issued_by: 'ann', expires_at: '2026-11-22T11:20:00.000Z' } : null);
    const known = { ...FORCE, grant };
    expect(said(event('policy', { outcome: 'allow', changes: [], grant: 'grant_1' }), known)).toBe(`Allowed by ann’s standing grant until ${clockTime('2026-11-22T11:20:00.000Z')}`);
    expect(said(event('policy', { outcome: 'allow', changes: [], grant: 'grant_0' }), known)).toBe('Allowed by a standing grant');
  });
});

describe('an edit on approval', () => {
  const edit = { by: 'bob', at: '2026-11-22T10:00:00.000Z', params: { force_n: 40, speed_mps: 0.25 }, digest: 'e' };
  const asked = { id: 'esc_1', constrained: { force_n: 60, speed_mps: 0.25 }, effective: edit.params, edits: [edit], needed: 2 };
  const answer = (decision: string, by: string, approvals: [string, string][]): string =>
    said(event('approval', { decision, escalation: { ...asked, approvals: approvals.map(([who, at]) => ({ by: who, at, digest: 'e' })) } }, 'inv_1', by));

  it('says what it changed, and that it voids what was approved before', () => {
    expect(answer('approve', 'bob', [['bob', '2026-11-22T10:00:00.003Z']])).toBe('bob edited: grip force 60 → 40 N, and approved, 1 of 2; no earlier approval counts');
    expect(answer('edit', 'bob', [])).toBe('bob edited, and policy cut it further: grip force 60 → 40 N; no earlier approval counts');
  });

  it('is not told again with the approvals that follow', () => {
    expect(answer('approve', 'ann', [['bob', '2026-11-22T10:00:00.003Z'], ['ann', '2026-11-22T10:00:09.000Z']])).toBe('ann approved, 2 of 2');
    expect(answer('approve', 'bob', [['bob', '2026-11-22T10:00:09.000Z']])).toBe('bob approved, 1 of 2');
  });
});

describe('an edit of a question that is open', () => {
  const constrained = { force_n: 60, speed_mps: 0.25 };
  const before = escalation({ constrained, needed: 2, approvals: [{ by: 'ann', at: '', digest: 'sha256:1' }] });
  const edit = { by: 'bob', at: '2026-11-22T10:00:00.000Z', params: { force_n: 40, speed_mps: 0.25 }, digest: 'e' };
  const after = escalation({ ...before, digest: 'e', edits: [edit], approvals: [{ by: 'bob', at: '', digest: 'e' }] });
  const approved = (of: object): LogEvent => event('approval', { decision: 'approve', escalation: { ...of } }, 'inv_1', 'ann');

  it('tells of approvals that count no more', () => {
    const told = event('approval', { decision: 'void', givers: ['ann'], escalation: { needed: 2, approvals: [] } }, 'inv_1', 'server');
    expect(eventLine(told).text).toBe('The approval of ann counts no more, with their token; 0 of 2');
  });

  it('stands until it is no longer what is asked, and only where it changed something', () => {
    expect(standingEdit(after)?.steps).toEqual([{ name: 'force_n', from: 60, to: 40 }]);
    expect(standingEdit({ ...after, digest: 'another policy' })).toBeNull();
    expect(standingEdit({ ...after, edits: [{ ...edit, params: constrained }] })).toBeNull();
    expect(standingEdit(before)).toBeNull();
  });

  it('voids the approval that somebody gave before it, until they give another', () => {
    const log = [approved(before)];
    expect(['ann', 'bob', null].map((who) => voidedOf(after, log, who))).toEqual([true, false, false]);
    expect(voidedOf(before, log, 'ann')).toBe(false);
    expect(voidedOf({ ...after, approvals: [...after.approvals, { by: 'ann', at: '', digest: 'e' }] }, [...log, approved(after)], 'ann')).toBe(false);
    expect(voidedOf(after, [approved({ ...before, id: 'esc_2' })], 'ann')).toBe(false);
    const anew: Escalation = { ...before, digest: 'another profile', renewed: 'profile_changed', approvals: [] };
    expect(['ann', 'bob'].map((who) => voidedOf(anew, log, who))).toEqual([true, false]);
    expect(voidedOf({ ...anew, approvals: [{ by: 'ann', at: '', digest: anew.digest }] }, [...log, approved(anew)], 'ann')).toBe(false);
    expect(voidedOf({ ...before, digest: 'the gripper holds something else', approvals: [] }, log, 'ann')).toBe(true);
    expect([changedWords(anew), changedWords(before)]).toEqual(['The cell was put under another profile, and this is asked anew.', 'What is asked has changed since it came.']);
  });
});

describe('what a cell says it was told', () => {
  it('is said in words an operator uses', () => {
    const said = (op: string): string => eventLine(event('human', { op }, 'inv_1', 'workcell-1')).text.trim();
    expect(said('confirm')).toBe('goes on, as a person confirmed');
    expect(said('end_takeover')).toBe('ended the session that was driven by hand');
    expect(said('acknowledge')).toBe('has seen the question');
    expect(said('new_word')).toBe('said new word');
  });

  it('says whether a person answered, or nobody in time, and why nothing came of it', () => {
    const echo = (op: string, more: Record<string, boolean | string | null> = {}): string =>
      eventLine(event('human', { op, done: !('refused' in more), refused: null, ...more }, 'inv_1', 'workcell-1')).text.trim();
    expect(echo('resolve_continue')).toBe('obeys: go on, as a person answered');
    expect(echo('resolve_terminate')).toBe('obeys: end it, as a person answered');
    expect(echo('resolve_terminate', { expired: true })).toBe('obeys: end it, as nobody answered in time');
    expect(echo('rollback', { expired: true })).toBe('obeys: rollback, as nobody answered in time');
    expect(echo('escalate', { refused: 'no_such_session' })).toBe('does not obey: ask a person, as policy has changed, it runs no such session any more');
  });

  it('is told of what befell a cell, a launch and a version as well', () => {
    expect(eventLine(event('cell', { what: 'never_taken', cell: 'workcell-1' }, 'inv_1', 'server')).text).toBe('Cell: it never came under the controls');
    expect(eventLine(event('cell', { what: 'new_thing' }, null, 'cell')).text).toBe('Cell: new thing');
    expect(eventLine(event('launch', { refused: 'wrong_policy' }, 'inv_1', 'cell')).text.trim()).toBe('the authorization is under another policy');
    expect(eventLine(event('policy_version', { op: 'awaiting_second', policy_version: 'sha256:0123456789' }, null, 'ann')).text).toBe('Policy 0123456: waits for a second engineer');
  });
});

describe('a key that several listen to', () => {
  const escape = { key: 'Escape', code: 'Escape', repeat: false, ctrlKey: false, metaKey: false, altKey: false, defaultPrevented: false };

  it('goes to the newest that takes it', () => {
    const keys = new Keys();
    const heard: string[] = [];
    keys.on('Escape', 'Close the menu', () => heard.push('menu'));
    keys.on('Escape', 'Close this list', () => { heard.push('list'); return false; });
    expect(keys.press(escape, false)).toBe(true);
    expect(heard).toEqual(['list', 'menu']);
  });

  it('is left to the page where nobody takes it', () => {
    const keys = new Keys();
    keys.on('Escape', 'Close this list', () => false);
    expect(keys.press(escape, false)).toBe(false);
  });
});
