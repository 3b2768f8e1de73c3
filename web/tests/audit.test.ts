import { describe, expect, it, vi } from 'vitest';
import type { Checkpoint, EventList, Invocation, LogEvent, Verification } from '../src/lib/api/documents';
import { invocation } from './samples';
import { LogCheck } from '../src/lib/audit/check.svelte';
import { judge } from '../src/lib/audit/integrity';
import { eventQuery, findEvents, matches, newest, NOTHING_LOOKED_AT, NOTHING_WANTED, renewed } from '../src/lib/audit/search';
import { clock } from '../src/lib/state/clock.svelte';

const signed: Checkpoint = { size: 40, root: 'aaa', checkpoint: '', key: '' };
const found: Verification = { ok: true, size: 40, root: 'aaa', checkpoint: '', first_bad: null, problem: null };

describe('integrity', () => {
  it('is good where everything signed is there, also when the log has grown since', () => {
    expect(judge(signed, found, null, 1)).toEqual({ is: 'good', size: 40, root: 'aaa', atMs: 1 });
    expect(judge(signed, { ...found, size: 44, root: 'bbb' }, { size: 40, root: 'aaa' }, 1).is).toBe('good');
  });

  it.each([
    ['an event was altered', { ...found, ok: false, size: 6, first_bad: 7, problem: 'its bytes do not match' }, null, 'its bytes do not match'],
    ['less is stored than was signed', { ...found, size: 39 }, null, 'vouches for 40 events, 39 are stored'],
    ['the roots differ', { ...found, root: 'bbb' }, null, 'not the signed one'],
    ['it shrank since this console looked', { ...found }, { size: 50, root: 'zzz' }, 'has seen 50 events, 40 are left'],
    ['it was rewritten since this console looked', { ...found }, { size: 40, root: 'zzz' }, 'another root'],
  ])('is bad when %s', (_, verification, seen, says) => {
    const judged = judge(signed, verification, seen, 1);
    expect(judged.is).toBe('bad');
    expect(judged.is === 'bad' && judged.problem).toContain(says);
  });
});

describe('the check of the log', () => {
  it('is repeated where the log has grown since, or nothing is known, and where it does not hold, stays as it is', async () => {
    const [check, asked] = [new LogCheck(), vi.fn()];
    let says: Verification = found;
    const api = { checkpoint: () => Promise.resolve(signed), verify: () => (asked(), Promise.resolve(says)) };
    await check.runUnlessHolds(api, 40);
    await check.runUnlessHolds(api, 40);
    expect(asked).toHaveBeenCalledTimes(1);
    says = { ...found, size: 44, root: 'bbb' };
    await check.runUnlessHolds(api, 44);
    expect([asked.mock.calls.length, check.now]).toMatchObject([2, { is: 'good', size: 44 }]);
    says = { ...found, size: 43 };
    await check.runUnlessHolds(api, 43); // it was put back: shorter than what was found to hold
    says = found;
    await check.runUnlessHolds(api, 50);
    expect([asked.mock.calls.length, check.now.is]).toEqual([3, 'bad']);
  });
});

it('says when the log was checked by the server’s time, whatever this computer takes it for', async () => {
  const told = vi.spyOn(clock, 'read').mockReturnValue(Date.parse('2026-11-22T10:00:00Z'));
  const check = new LogCheck();
  await check.run({ checkpoint: () => Promise.resolve(signed), verify: () => Promise.resolve(found) });
  told.mockRestore();
  expect(check.now).toMatchObject({ is: 'good', atMs: Date.parse('2026-11-22T10:00:00Z') });
});

describe('a log that does not hold', () => {
  it('holds no more for a check that got no answer', async () => {
    const check = new LogCheck();
    const api = { checkpoint: () => Promise.resolve(signed), verify: () => Promise.resolve({ ...found, size: 39 }) };
    await check.run(api);
    const bad = check.now;
    await check.run({ ...api, verify: () => Promise.reject(new Error('no answer')) });
    expect([bad.is, check.now]).toEqual(['bad', bad]);
    await check.run({ ...api, verify: () => Promise.resolve(found) });
    expect(check.now.is).toBe('good');
  });
});

describe('looking for events', () => {
  it('asks the log for what it can filter, times as instants', () => {
    const query = eventQuery({ ...NOTHING_WANTED, kind: 'alert', actor: ' planner ', since: '2026-03-01T09:30:00' }, 7, 100, false);
    expect(Object.fromEntries(query)).toEqual({ order: 'oldest', after: '7', limit: '100', kind: 'alert', actor: 'planner', since: new Date('2026-03-01T09:30:00').toISOString() });
    expect(Object.fromEntries(eventQuery({ ...NOTHING_WANTED, text: ' mug_1 limit ' }, 7, 100, true))).toEqual({ order: 'newest', before: '7', limit: '100', text: 'mug_1 limit' });
    expect(eventQuery(NOTHING_WANTED, null, 100, true).has('before')).toBe(false);
  });

  it('says how far it has come, and leaves the rest to whoever wants it', async () => {
    const asked: (string | null)[] = [];
    const events = (query: URLSearchParams): Promise<EventList> => {
      asked.push(query.get('before'));
      const seq = Number(query.get('before') ?? 1_000_000) - 50_000;
      return Promise.resolve({ items: [], next: seq, searched: { events: 50_000, seq, at: `at ${seq}` } });
    };
    const { items, next, looked } = await findEvents({ events, invocations: () => Promise.reject(new Error()) }, { ...NOTHING_WANTED, text: 'nobody' }, null, true);
    expect([items.length, next, looked, asked]).toEqual([0, 800_000, { count: 200_000, at: 'at 800000' }, [null, '950000', '900000', '850000']]);
  });

  it('finds those of a capability however many sessions of it came since', async () => {
    const pages = 30;
    const api = {
      invocations: (query: URLSearchParams) => {
        const page = Number(query.get('cursor') ?? 0);
        return Promise.resolve({ items: [invocation({ id: `inv_${page}` })], next: page + 1 < pages ? String(page + 1) : null });
      },
      events: () => Promise.resolve({ items: [{ seq: 1, at: '', kind: 'proposal', invocation: `inv_${pages - 1}`, actor: 'x', body: {} }], next: null }),
    };
    const { items } = await findEvents(api, { ...NOTHING_WANTED, capability: 'grasp_object' }, null, false);
    expect(items.map((one) => one.invocation)).toEqual([`inv_${pages - 1}`]);
  });

  it('finds those of a capability on whichever page they stand', async () => {
    const event = (seq: number, invocation: string): LogEvent => ({ seq, at: '', kind: 'launch', invocation, actor: 'x', body: {} });
    const pages: Record<string, { items: LogEvent[]; next: number | null }> = {
      0: { items: [event(1, 'inv_a'), event(2, 'inv_b')], next: 2 },
      2: { items: [event(3, 'inv_b'), event(4, 'inv_a')], next: null },
    };
    const api = {
      events: (query: URLSearchParams) => Promise.resolve(pages[query.get('after') ?? '0'] ?? { items: [], next: null }),
      invocations: () => Promise.resolve({ items: [{ id: 'inv_b' } as Invocation], next: null }),
    };
    const { items, next } = await findEvents(api, { ...NOTHING_WANTED, capability: 'grasp_object' }, null, false);
    expect([items.map(({ seq }) => seq), next]).toEqual([[2, 3], null]);
  });

  it('matches a session by part of its name, its agent, and the time it lasted', () => {
    const session = { ...invocation(), id: 'inv_01ABC', created_at: '2026-03-01T09:30:00Z', updated_at: '2026-03-01T09:40:00Z' };
    expect(matches(session, { ...NOTHING_WANTED, invocation: '1AB', actor: 'planner', since: '2026-03-01T09:35:00Z', until: '2026-03-01T09:36:00Z' })).toBe(true);
    expect(matches(session, { ...NOTHING_WANTED, since: '2026-03-01T09:41:00Z' })).toBe(false);
    expect(matches(session, { ...NOTHING_WANTED, actor: 'plan' })).toBe(false);
  });

  it.each([['GRASP mug_1', true], ['tcp_speed', true], ['0.25 running', true], ['workcell-1 human-shared', true], ['mug_2', false], ['mug_1 mug_2', false], ['undefined', false]])(
    'matches a session by the words %s, wherever they stand in it: %s',
    (text, so) => expect(matches(invocation(), { ...NOTHING_WANTED, text })).toBe(so),
  );

  it('matches a session by the words in which its end is told of', () => {
    expect(matches(invocation({ status: 'completed', outcome: 'succeeded' }), { ...NOTHING_WANTED, text: 'done verified' })).toBe(true);
  });
});

describe('sessions that are listed', () => {
  const page = (ids: string, next: string | null, status: Invocation['status'] = 'running') => ({ items: ids.split(/(?=.)/).map((id) => invocation({ id, status })), next, looked: NOTHING_LOOKED_AT });
  const told = ({ items, next }: ReturnType<typeof renewed>) => [items.map(({ id }) => id).join(''), next];

  it('are renewed from their beginning, and keep what was fetched behind it', () => {
    const now = renewed(page('fedcba', 'a'), page('hgfe', 'e', 'completed'));
    expect(told(now)).toEqual(['hgfedcba', 'a']);
    expect(now.items.map(({ status }) => status).slice(2, 5)).toEqual(['completed', 'completed', 'running']);
  });

  it('are those of the beginning alone where it holds all, reaches further, or does not meet what was there', () => {
    expect(told(renewed(page('dcba', null), page('edc', null)))).toEqual(['edc', null]);
    expect(told(renewed(page('dc', 'c'), page('edcb', 'b')))).toEqual(['edcb', 'b']);
    expect(told(renewed(page('ba', 'a'), page('zy', 'y')))).toEqual(['zy', 'y']);
    expect(told(renewed(page('', null), page('ba', 'a')))).toEqual(['ba', 'a']);
  });

  it('stand as they are known by now, unless what was found is newer', () => {
    const found = invocation({ updated_at: '2026-11-22T10:00:00.500Z' });
    const ended = invocation({ status: 'completed', updated_at: '2026-11-22T10:00:01Z' });
    expect(newest(found, ended).status).toBe('completed');
    expect(newest(ended, found).status).toBe('completed');
    expect(newest(found, undefined)).toBe(found);
  });
});
