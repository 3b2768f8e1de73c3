import { describe, expect, it } from 'vitest';
import type { Invocation, LogEvent } from '../src/lib/api/documents';
import { closingOf, endWords, lapseWords } from '../src/lib/live/closed';
import { clockTime } from '../src/lib/format/time';
import { escalation, event, invocation } from './samples';

describe('a question that others closed', () => {
  const ASKED = { id: 'esc_1', invocation: 'inv_1' };
  const about = (status: string, decision: string, id = 'esc_1'): LogEvent => event('approval', { decision, escalation: { id, status, approvals: [{ by: 'operator' }], needed: 1 } }, 'inv_1', 'operator_2');
  const asks = (status: string, kind = 'session'): LogEvent => event('escalation', { escalation: { id: 'esc_1', status, kind } }, 'inv_1', 'server');
  const word = (op: string): LogEvent => event('human', { op, role: 'operator' }, 'inv_1', 'operator');
  const words = (log: LogEvent[], of: Invocation | null = null): string | null => closingOf(log, ASKED, of).words;

  it('is told of by who answered what', () => {
    expect(words([about('approved', 'approve'), about('denied', 'deny', 'esc_2')])).toBe('operator_2 approved it.');
    expect(words([about('approved', 'approve'), event('launch', { permit: 'auth_1' })])).toBe('operator_2 approved it: it was launched.');
    expect(words([about('pending', 'approve'), about('denied', 'deny')])).toBe('operator_2 denied.');
    expect(words([asks('pending'), asks('expired')])).toBe('Nobody answered in time.');
    expect(words([event('approval', { escalation: { id: 'esc_1', status: 'approved', kind: 'session' } }, 'inv_1', 'ann')])).toBe('ann let it go on.');
    const held = (more: LogEvent['body']): string | null => words([event('approval', { escalation: { id: 'esc_1', status: 'denied', kind: 'session', ...more } }, 'inv_1', 'ann')]);
    expect([held({ on_deny: 'terminate' }), held({ on_deny: 'rollback' }), held({ kind: 'approval', on_deny: 'deny' })]).toEqual(['ann ended it.', 'ann had it rolled back.', 'ann denied.']);
  });

  it('that was approved in vain says why', () => {
    const answer = about('approved', 'approve');
    const busy = event('outcome', { status: 'deferred', outcome: 'deferred', reasons: [{ message: 'the cell `workcell-1` is busy' }] }, 'inv_1', 'server');
    const late = closingOf([answer, busy], ASKED, invocation({ status: 'deferred', outcome: 'deferred' }));
    expect(late).toEqual({ words: 'operator_2 approved it, but it was deferred: the cell workcell-1 is busy.', inVain: true, lapsed: false });
    const refused = closingOf([about('approved', 'approve'), event('launch', { refused: 'no_plan' })], ASKED, null);
    expect(refused).toEqual({ words: 'operator_2 approved it, but in vain: launch refused: it has no plan to watch it by.', inVain: true, lapsed: false });
  });

  it('was approved for nothing where somebody denied, withdrew or outlived it, and nowhere else', () => {
    const vain = (...log: LogEvent[]): boolean => closingOf(log, ASKED, invocation({ outcome: 'stopped' })).inVain;
    expect([vain(about('denied', 'deny')), vain(asks('pending'), asks('withdrawn')), vain(asks('expired')), vain(asks('pending'), word('cancel'))]).toEqual([true, true, true, true]);
    expect([vain(about('approved', 'approve')), vain(asks('pending')), vain()]).toEqual([false, false, false]);
  });

  it('that was withdrawn says by whose word, and only of what has ended that it is over', () => {
    const running = invocation({ status: 'recovering' });
    expect(words([asks('pending'), word('rollback'), asks('withdrawn')], running)).toBe('It was withdrawn: operator ordered a rollback.');
    expect(words([asks('pending'), word('takeover'), asks('withdrawn')], running)).toBe('It was withdrawn: operator took over.');
    expect(words([word('takeover'), asks('pending'), word('pause'), asks('withdrawn')], running)).toBe('It was withdrawn.');
    expect(words([asks('pending'), asks('withdrawn')], invocation({ outcome: 'stopped' }))).toBe('It is over.');
  });

  it('that a cell withdrew says by whose word even when the session has asked again since', () => {
    const asked = (id: string): LogEvent => event('status', { status: 'escalated', escalation: { id, status: 'pending', kind: 'session' } });
    const log = [asked('esc_0'), word('stop'), asked('esc_1'), event('escalation', { reason: 'no_progress' }), word('takeover'), event('status', { status: 'taken_over', withdrawn: 'esc_1' })];
    const again = [...log, asked('esc_2'), event('escalation', { reason: 'control_lapsed' }), word('rollback')];
    expect([words(log), words(again)]).toEqual(['It was withdrawn: operator took over.', 'It was withdrawn: operator took over.']);
    expect(closingOf(again, { id: 'esc_2', invocation: 'inv_1' }, null).words).toBe('It was withdrawn: operator ordered a rollback.');
  });

  it('is called withdrawn only where its record is here, for it may have been approved while the link was away', () => {
    expect([endWords([asks('pending')], ASKED), endWords([], ASKED)]).toEqual(['It was withdrawn.', 'Audit tells what became of it.']);
  });

  it('that lapsed says who answered, and whose answer was missing', () => {
    const lapsed = (given: number, needed: number): string | null => words([event('escalation', { escalation: { id: 'esc_1', status: 'expired', needed, approvals: Array.from({ length: given }, () => ({ by: 'ann' })) } })]);
    expect([lapsed(0, 2), lapsed(1, 2), lapsed(1, 3), lapsed(2, 3)]).toEqual([
      'Nobody answered in time.',
      '1 of 2 approved; the second did not answer in time.',
      '1 of 3 approved; the others did not answer in time.',
      '2 of 3 approved; the last one did not answer in time.',
    ]);
  });

  it('that lapsed after an approval was taken off is not said to have had no answer', () => {
    const asked = escalation({ id: 'esc_1', needed: 2 });
    const taken = event('approval', { decision: 'void', givers: ['ann'], escalation: { id: 'esc_1', status: 'pending', needed: 2, approvals: [] } }, 'inv_1', 'server');
    const over = event('escalation', { escalation: { id: 'esc_1', status: 'expired', needed: 2, approvals: [] } }, 'inv_1', 'server');
    expect(words([asks('pending'), about('pending', 'approve'), taken, over])).toBe('0 of 2 approved when the time was over.');
    expect(lapseWords({ asked, at: over.at }, false, [taken, over])).toContain('0 of 2 approved');
    expect(lapseWords({ asked, at: over.at }, false, [over])).toContain('nobody answered');
  });

  it('because its cell was put under another profile, or another policy came, says so and what came of it', () => {
    const gone = (renewed: string): LogEvent => event('escalation', { escalation: { id: 'esc_1', status: 'withdrawn', kind: 'approval', cell: 'workcell-1', renewed } });
    const put = (cell: string, by: string): LogEvent => event('profile_changed', { cell, before: 'human-shared', profile: 'fenced' }, null, by);
    const ended = (outcome: string, code: string): LogEvent => event('outcome', { outcome, reasons: [{ code, message: 'the robot is too near.' }] });
    const changed = (...after: LogEvent[]): LogEvent[] => [asks('pending', 'approval'), put('workcell-1', 'ann'), put('workcell-2', 'bob'), gone('profile_changed'), ...after].map((one, k) => ({ ...one, seq: k + 1 }));
    expect(words(changed(ended('deferred', 'profile_changed')))).toBe('It was withdrawn: ann put the cell under another profile. It did not begin, and may be proposed again.');
    expect(words(changed(ended('denied', 'too_near')))).toBe('It was withdrawn: ann put the cell under another profile. It was denied: the robot is too near.');
    expect(closingOf(changed(), ASKED, null, 'ann').words).toBe('It was withdrawn: you put the cell under another profile.');
    expect(words([gone('profile_changed')])).toBe('It was withdrawn: the cell was put under another profile.');
    expect(words([gone('policy_changed'), event('launch', { permit: 'auth_1' })])).toBe('It was withdrawn: another policy came into force. It was launched.');
    expect(words([asks('pending'), word('cancel'), gone('profile_changed')])).toBe('It was withdrawn: operator cancelled it.'); // asked anew under it, and then cancelled
  });

  it('is told to whoever did it without their name', () => {
    const mine = (log: LogEvent[], me: string): string | null => closingOf(log, ASKED, null, me).words;
    expect(mine([about('denied', 'deny')], 'operator_2')).toBe('You denied.');
    expect(mine([about('approved', 'approve')], 'operator_2')).toBe('You approved it.');
    expect(mine([asks('pending'), word('takeover'), asks('withdrawn')], 'operator')).toBe('It was withdrawn: you took over.');
    expect(mine([about('denied', 'deny')], 'operator')).toBe('operator_2 denied.');
  });

  it('is nothing that can be told of where the record is not here', () => {
    expect(words([about('pending', 'approve')], invocation())).toBeNull();
  });
});

it('a question that lapsed names nothing that the gripper holds by now', () => {
  const put = escalation({ capability: 'place_object', effective: { surface: 'bench_b' }, needed: 2, cell: 'workcell-1' });
  const at = '2026-11-22T10:00:02Z';
  const told = `(${clockTime(at)}, nobody answered)`;
  expect([false, true].map((several) => lapseWords({ asked: put, at }, several))).toEqual([`Put what it held on bench_b ${told}`, `Put what it held on bench_b in workcell-1 ${told}`]);
});
