import { beforeEach, describe, expect, it } from 'vitest';
import { ApiError } from '../src/lib/api/client';
import type { Invocation, List, LogEvent } from '../src/lib/api/documents';
import { Finding } from '../src/lib/audit/finding.svelte';
import { NOTHING_WANTED } from '../src/lib/audit/search';
import { event, invocation } from './samples';

describe('what is looked for in the record', () => {
  let sessions: { give: (...ids: string[]) => void; fail: () => void }[];
  let events: ((next: number | null, ...items: LogEvent[]) => void)[];
  let orders: (string | null)[];
  let signals: (AbortSignal | undefined)[];
  let finding: Finding;
  const listed = (): string[] => finding.sessions.map(({ id }) => id);
  const settled = (): Promise<void> => new Promise((resolve) => setTimeout(resolve));

  beforeEach(() => {
    [sessions, events, orders, signals] = [[], [], [], []];
    finding = new Finding({
      invocations: () =>
        new Promise<List<Invocation>>((give, fail) =>
          sessions.push({ give: (...ids) => give({ items: ids.map((id) => invocation({ id })), next: 'more' }), fail: () => fail(new ApiError({ title: '', status: 0, detail: 'no answer', code: 'unreachable' })) }),
        ),
      events: (query, until) => (orders.push(query.get('order')), signals.push(until), new Promise<List<LogEvent>>((give) => events.push((next, ...items) => give({ items, next })))),
    });
  });

  it('is told of by the answer to the newest question, and by its failure alone', async () => {
    void finding.look('sessions', NOTHING_WANTED);
    void finding.look('sessions', { ...NOTHING_WANTED, actor: 'planner' });
    sessions[1]?.give(...Array.from({ length: 50 }, (_, k) => `inv_${k}`));
    await settled();
    sessions[0]?.fail();
    await settled();
    expect([listed().length, finding.why, finding.busy]).toEqual([50, '', false]);
  });

  it('is read anew by the newest of those readings', async () => {
    const many = Array.from({ length: 50 }, (_, k) => `old_${k}`);
    void finding.look('sessions', NOTHING_WANTED);
    sessions[0]?.give(...many);
    await settled();
    void finding.renew();
    void finding.renew();
    sessions[2]?.give('inv_b', 'inv_a', ...many);
    await settled();
    sessions[1]?.give('inv_a', ...many);
    await settled();
    expect(listed().slice(0, 2)).toEqual(['inv_b', 'inv_a']);
  });

  it('is no more listed once something else is asked for, and a search stays as it was answered', async () => {
    void finding.look('sessions', NOTHING_WANTED);
    sessions[0]?.give(...Array.from({ length: 50 }, (_, k) => `inv_${k}`));
    await settled();
    void finding.look('sessions', { ...NOTHING_WANTED, text: 'planner' });
    expect([listed(), finding.next, finding.searched]).toEqual([[], null, true]);
    sessions[1]?.give(...Array.from({ length: 50 }, (_, k) => `new_${k}`));
    await settled();
    await finding.renew();
    expect([sessions.length, listed()[0]]).toEqual([2, 'new_0']);
  });

  it('is listed by the newest event first, and by the oldest once it is turned round', async () => {
    void finding.look('events', { ...NOTHING_WANTED, text: 'here' });
    events[0]?.(null, event('launch', {}));
    await settled();
    void finding.turnRound();
    expect([orders, finding.events]).toEqual([['newest', 'oldest'], []]);
  });

  it('is kept where a search came no further, and the search goes on from there', async () => {
    const [sight, looks] = [event('launch', {}), [] as (string | null)[]];
    const searched = (seq: number): { events: number; seq: number; at: string } => ({ events: 50_000, seq, at: '2026-03-01T09:30:00.000Z' });
    let down = false;
    const broken = new Finding({
      invocations: () => Promise.reject(new Error('nobody asked')),
      events: (query) => {
        looks.push(query.get('before'));
        if (down) return Promise.reject(new ApiError({ title: '', status: 0, detail: 'no answer', code: 'unreachable' }));
        down = looks.length === 1;
        return Promise.resolve({ items: looks.length === 1 ? [sight] : [], next: looks.length === 1 ? 900 : null, searched: searched(900) });
      },
    });
    await broken.look('events', { ...NOTHING_WANTED, text: 'here' });
    expect([broken.events, broken.next, broken.looked.count, broken.why, broken.busy]).toEqual([[sight], 900, 50_000, 'No answer.', false]);
    down = false;
    await broken.more();
    expect([broken.events, broken.next, broken.looked.count, broken.why, looks]).toEqual([[sight], null, 100_000, '', [null, '900', '900']]);
  });

  it('is asked for no further once something else is, or the page is left', () => {
    void finding.look('events', { ...NOTHING_WANTED, text: 'here' });
    void finding.look('events', { ...NOTHING_WANTED, text: 'there' });
    expect(signals.map((signal) => signal?.aborted)).toEqual([true, false]);
    finding.leave();
    expect(signals[1]?.aborted).toBe(true);
  });

  it('begins anew with what is found elsewhere: nothing is listed twice', async () => {
    const logged = [event('launch', {}), event('outcome', {})];
    void finding.look('events', NOTHING_WANTED);
    events[0]?.(null, ...logged);
    await settled();
    void finding.look('sessions', NOTHING_WANTED);
    sessions[0]?.give(...Array.from({ length: 50 }, (_, k) => `inv_${k}`));
    await settled();
    void finding.look('events', NOTHING_WANTED);
    void finding.more(); // of the sessions that it still ends with
    events[1]?.(null, ...logged);
    events[2]?.(null, ...logged);
    await settled();
    expect(finding.events.map(({ seq }) => seq)).toEqual(logged.map(({ seq }) => seq));
  });
});
