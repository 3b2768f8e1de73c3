import { afterEach, describe, expect, it, vi } from 'vitest';
import { ApiError } from '../src/lib/api/client';
import { Orders } from '../src/lib/live/orders.svelte';
import type { Console } from '../src/lib/state/console.svelte';
import { cell, heldBy, invocation } from './samples';

/** Takes every word, and keeps what was said. */
function telling(told: string[]): object {
  const word = (_: string, said: string, after?: number): Promise<number> => Promise.resolve(told.push(after === undefined ? said : `${said} after ${after}`));
  return { restrain: word, loosen: word };
}

/** What an operator may order of a session, of which its record says one thing and its cell another. */
function orders(recorded: string, said: string, ...by: string[]): { may: string; told: string[] } {
  const session = invocation({ status: recorded as never });
  const told: string[] = [];
  const seen = { session, cell: cell({ busy: session.id, status: said, session: heldBy(...by) }), live: true, me: { role: 'operator' }, docs: { seq: 178, escalations: {}, events: [] }, api: telling(told) };
  const given = new Orders(seen as unknown as Console);
  given.pause();
  given.resume();
  return { may: [given.pausable ? 'pause' : '', given.resumable ? 'resume' : ''].join(' ').trim(), told };
}

describe('what is ordered of a session', () => {
  afterEach(() => vi.useRealTimers());

  it.each([
    ['running', 'running', [], 'pause', ['pause']],
    ['paused', 'paused', ['operator'], 'pause resume', ['resume after 178']],
    ['paused', 'running', [], 'pause', ['pause']], // resumed, and the record is late
    ['escalated', 'running', [], 'pause', ['pause']], // answered, and the record is late
    ['escalated', 'escalated', [], '', []],
  ])('that its record calls %s and its cell %s, held by %j, is: %s', (recorded, said, by, may, told) => {
    expect(orders(recorded, said, ...by)).toEqual({ may, told });
  });

  it('is a pause at most while the link is down', () => {
    const session = invocation({ status: 'running' });
    const told: string[] = [];
    const down = { session, cell: cell({ busy: session.id, status: 'running' }), live: false, me: { role: 'operator' }, docs: { seq: 178, escalations: {}, events: [] }, api: telling(told) };
    const given = new Orders(down as unknown as Console);
    given.rollBack();
    given.pause();
    expect([given.pausable, given.undoable, told]).toEqual([true, false, ['pause']]);
    const held = { ...down, session: invocation({ status: 'paused' }), cell: cell({ busy: session.id, status: 'paused', session: heldBy('operator') }) };
    expect(new Orders(held as unknown as Console).resumable).toBe(false);
    expect(new Orders({ ...down, me: { role: 'auditor' } } as unknown as Console).pausable).toBe(false);
    const silent = new Orders({ ...held, live: true, cell: { ...held.cell, online: false } } as unknown as Console);
    const heard = new Orders({ ...held, live: true } as unknown as Console);
    expect([silent, heard].map(({ resumable, undoable }) => [resumable, undoable])).toEqual([[false, false], [true, true]]);
  });

  it('is a pause at once after what let the session go on, whatever is shown of it still', async () => {
    vi.useFakeTimers();
    const session = invocation({ status: 'paused' });
    const answers: { give: () => void; fail: (why: Error) => void }[] = [];
    const told: string[] = [];
    const loosen = (_: string, word: string): Promise<void> => new Promise((give, fail) => answers.push({ give, fail }) && told.push(word));
    const seen = { session, cell: cell({ busy: session.id, status: 'paused', session: heldBy('operator') }), live: true, me: { role: 'operator' }, docs: { seq: 178, escalations: {}, events: [] }, api: { ...telling(told), loosen } };
    const given = new Orders(seen as unknown as Console);
    given.pause();
    given.resume();
    given.pause();
    expect(told).toEqual(['resume', 'pause']);
    answers[0]?.give();
    await vi.advanceTimersByTimeAsync(1_000);
    expect(given.pausable).toBe(true);
    await vi.advanceTimersByTimeAsync(3_000);
    expect(given.pausable).toBe(false); // by now it is as it is shown
    const refused = { title: 'Refused', status: 409, detail: 'No.', code: 'overtaken' };
    for (const [code, stands] of [['overtaken', false], ['unreachable', true]] as const) {
      given.resume();
      answers.at(-1)?.fail(new ApiError({ ...refused, code }));
      await vi.advanceTimersByTimeAsync(0);
      expect([code, given.pausable]).toEqual([code, stands]);
    }
  });

  it('names the cell that a refusal is about once another one is looked at', async () => {
    const session = invocation({ status: 'running', cell: 'workcell-1' });
    const here = { session, cell: cell({ busy: session.id, status: 'running' }), live: true, me: { role: 'operator' }, docs: { seq: 178, escalations: {}, events: [] }, api: { restrain: () => Promise.reject(new Error('No answer.')) } };
    const seen = { ...here };
    const given = new Orders(seen as unknown as Console);
    given.pause();
    await Promise.resolve().then(() => undefined);
    expect(given.problem).toBe('No answer.');
    seen.cell = cell({ id: 'workcell-2' });
    expect(given.problem).toBe('Pause in workcell-1: No answer.');
    given.understood();
    expect(given.problem).toBe('');
  });

  it('is said to be on its way once it has had no answer for a while', async () => {
    vi.useFakeTimers();
    const session = invocation({ status: 'running' });
    let answer: () => void = () => undefined;
    const restrain = (): Promise<void> => new Promise((resolve) => (answer = resolve));
    const seen = { session, cell: cell({ busy: session.id, status: 'running' }), live: true, me: { role: 'operator' }, docs: { seq: 178, escalations: {}, events: [] }, api: { restrain } };
    const given = new Orders(seen as unknown as Console);
    given.pause();
    expect([given.unanswered, given.pausable]).toEqual([null, true]);
    await vi.advanceTimersByTimeAsync(500);
    expect([given.unanswered, given.pausable]).toEqual(['pause', true]); // pressed again, it is said again
    answer();
    await vi.advanceTimersByTimeAsync(0);
    expect(given.unanswered).toBe(null);
  });

  it('is said to be on its way beside the session that it was ordered of, and to none other', async () => {
    vi.useFakeTimers();
    const [one, two] = ['1', '2'].map((k) => ({ session: invocation({ id: `inv_${k}`, status: 'running', cell: `workcell-${k}` }), cell: cell({ id: `workcell-${k}`, busy: `inv_${k}`, status: 'running' }) }));
    const answers: { give: () => void; fail: () => void }[] = [];
    const restrain = (): Promise<void> => new Promise((give, fail) => answers.push({ give, fail: () => fail(new Error('No answer.')) }));
    const seen = { ...one, live: true, me: { role: 'operator' }, docs: { seq: 178, escalations: {}, events: [] }, api: { restrain } };
    const given = new Orders(seen as unknown as Console);
    given.pause();
    await vi.advanceTimersByTimeAsync(500);
    Object.assign(seen, two);
    expect(given.unanswered).toBe(null);
    given.pause();
    await vi.advanceTimersByTimeAsync(500);
    answers[0]?.fail();
    await vi.advanceTimersByTimeAsync(0);
    expect([given.unanswered, given.problem]).toEqual(['pause', 'Pause in workcell-1: No answer.']);
    given.pause(); // of another cell, it takes nothing back
    answers[1]?.fail();
    answers[2]?.fail();
    await vi.advanceTimersByTimeAsync(0);
    expect([given.unanswered, given.problem, given.told]).toEqual([null, 'Pause in workcell-1: No answer. No answer.', 'Pause in workcell-1: No answer. Pause in workcell-2: No answer.']);
  });
});
