import { describe, expect, it, vi } from 'vitest';
import type { LogEvent } from '../src/lib/api/documents';
import { deniedWords } from '../src/lib/format/denied';
import { inVainOn } from '../src/lib/live/control';
import { spares } from '../src/lib/live/grants';
import { sessionSays } from '../src/lib/live/said';
import { inSight, READ_MS, Sight } from '../src/lib/live/sight.svelte';
import { cell, escalation, event, invocation } from './samples';

describe('an approval that would come to nothing', () => {
  const control = { lease: 'l', holder: 'ann', where: 'remote' as const, since: '', invocation: 'inv_2' };
  const cells = [
    cell({ id: 'a', busy: null, latched: true }),
    cell({ id: 'b', busy: null }),
    cell({ id: 'c', busy: 'inv_2' }),
    cell({ id: 'd', busy: 'inv_2', control }),
    cell({ id: 'e', busy: 'inv_1' }),
  ];
  const on = (id: string | null): string | null => inVainOn(cells, { cell: id, invocation: 'inv_1' });

  it.each([
    ['a', /is stopped and would refuse it/],
    ['c', /is busy with another session/],
    ['d', /is driven by hand/],
  ])('is kept back for cell %s, with the reason', (id, words) => {
    expect(on(id)).toMatch(words);
  });

  it('is taken where the cell is free, or holds itself free for it', () => {
    expect([on('b'), on('e'), on('unknown')]).toEqual([null, null, null]);
  });

  it('is kept back for any cell only where none is free', () => {
    expect(on(null)).toBeNull();
    expect(inVainOn(cells.slice(0, 1), { cell: null, invocation: 'inv_1' })).toMatch(/^a is stopped/);
    expect(inVainOn([], { cell: null, invocation: 'inv_1' })).toBeNull();
  });
});

describe('how a session is getting on', () => {
  const [asked, began, now] = ['2026-11-22T10:00:00.000Z', '2026-11-22T10:00:50.000Z', Date.parse('2026-11-22T10:00:52.000Z')];
  const launches = (body: LogEvent['body'] = {}): LogEvent[] => [{ ...event('launch', body), at: began }];

  it('is counted from its launch, and a question from its proposal', () => {
    expect(sessionSays(invocation({ status: 'running', created_at: asked }), launches(), now)).toBe('0:02 running');
    expect(sessionSays(invocation({ status: 'awaiting_approval', created_at: asked }), [], now)).toBe('0:52 waits for approval');
  });

  it('says since when somebody drives it', () => {
    const control = { invocation: 'inv_1', since: '2026-11-22T10:00:51.000Z' };
    expect(sessionSays(invocation({ status: 'running' }), launches(), now, control)).toBe('0:01 driven by hand'); // however long it ran before
    expect(sessionSays(invocation({ status: 'running' }), launches(), now, { ...control, invocation: 'inv_2' })).toBe('0:02 running');
  });

  it('does not guess a launch that is not known, or was refused', () => {
    expect(sessionSays(invocation({ status: 'running' }), [], now)).toBe('running');
    expect(sessionSays(invocation({ status: 'running' }), launches({ refused: 'busy' }), now)).toBe('running');
  });

  it('is its outcome once it has one', () => {
    expect(sessionSays(invocation({ status: 'completed', outcome: 'succeeded' }), launches(), now)).toBe('done, verified');
  });
});

describe('a denial', () => {
  it('is told with its reason where one was chosen', () => {
    expect(deniedWords({ by: 'ann', code: 'wrong_target', says: 'this is not the right target' })).toBe('denied: this is not the right target');
    expect(deniedWords({ by: 'ann', code: 'unspecified', says: 'a human denied this' })).toBe('denied');
    expect([deniedWords(null), deniedWords(undefined)]).toEqual(['denied', 'denied']);
  });
});

describe('a standing grant', () => {
  it('is offered only where nothing asks but the profile', () => {
    const rule = { rule: 'organization/confidence', code: 'rule', message: '', remedy: '' };
    expect(spares(escalation())).toBe(true);
    expect(spares(escalation({ reasons: [...escalation().reasons, rule] }))).toBe(false);
  });
});

describe('what is asked', () => {
  const line = (at: number): Element => ({ at, compareDocumentPosition: (other: { at: number }) => (other.at > at ? 4 : 2) }) as unknown as Element;
  const [reasons, values] = [line(1), line(2)];
  const sight = (): Sight => {
    vi.stubGlobal('IntersectionObserver', class { observe(): void {} unobserve(): void {} disconnect(): void {} });
    const made = new Sight();
    made.watch(values); // whichever comes first
    made.watch(reasons);
    return made;
  };

  it('can be read of a line that is whole on the screen, or fills it', () => {
    expect([[true, 45, 44.4], [true, 45, 43], [false, 45, 45], [true, 800, 300], [true, 800, 200]].map(([meets, whole, shown]) => inSight(meets as boolean, whole as number, shown as number, 500))).toEqual([true, false, false, true, false]);
  });

  it('has been read once all of it was on the screen for a while, and while some of it is', () => {
    vi.useFakeTimers();
    const made = sight();
    const look = (at: Element, ms: number): void => {
      made.note(at, true);
      vi.advanceTimersByTime(ms);
    };
    expect([made.read, made.unread]).toEqual([false, [reasons, values]]);
    look(reasons, READ_MS);
    expect([made.read, made.unread]).toEqual([false, [values]]);
    look(values, READ_MS / 2); // no longer than until the answers stand before it
    made.note(values, false);
    vi.advanceTimersByTime(READ_MS);
    expect([made.read, made.unread]).toEqual([false, [values]]);
    made.note(reasons, false);
    look(values, READ_MS);
    expect([made.read, made.unread]).toEqual([true, []]);
    made.note(values, false);
    expect(made.read).toBe(false);
    made.note(reasons, true);
    expect(made.read).toBe(true);
    vi.useRealTimers();
  });

  it('is read by nobody behind what lies over the page', () => {
    vi.useFakeTimers();
    const made = sight();
    made.note(reasons, true);
    made.note(values, true);
    made.cover(true);
    vi.advanceTimersByTime(READ_MS);
    expect([made.read, made.unread]).toEqual([false, [reasons, values]]);
    made.cover(false);
    vi.advanceTimersByTime(READ_MS);
    expect([made.read, made.unread]).toEqual([true, []]);
    made.cover(true);
    expect(made.read).toBe(false);
    made.cover(false);
    expect(made.read).toBe(true);
    vi.useRealTimers();
  });

  it('is read anew once something else is asked: what stays in sight for as long again, and the rest where it stands', () => {
    vi.useFakeTimers();
    const made = sight();
    for (const part of [reasons, values]) made.note(part, true);
    vi.advanceTimersByTime(READ_MS);
    made.note(values, false);
    expect(made.read).toBe(true);
    made.anew();
    expect(made.unread).toEqual([reasons, values]);
    vi.advanceTimersByTime(READ_MS);
    expect([made.read, made.unread]).toEqual([false, [values]]);
    made.note(values, true);
    vi.advanceTimersByTime(READ_MS);
    expect(made.read).toBe(true);
    vi.useRealTimers();
  });
});
