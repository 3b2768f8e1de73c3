import { describe, expect, it } from 'vitest';
import type { LogEvent } from '../src/lib/api/documents';
import { clockTime } from '../src/lib/format/time';
import { endOf } from '../src/lib/live/grants';
import { Ends } from '../src/lib/state/ends.svelte';

const AT = '2026-11-22T10:00:02.000Z';

function recorded(seq: number, id: string, issuedBy: string, code = '', by = 'server'): LogEvent {
  const ended = code === '' ? null : { code, by, at: AT };
  const grant = { id, issued_by: issuedBy, ended, capability: 'grasp_object', agent: 'planner', cell: 'workcell-1', scope: 'object', object: 'mug_1', task: null };
  return { seq, kind: 'grant', at: AT, invocation: null, actor: by, body: { op: ended === null ? 'given' : 'ended', grant } };
}

function told(...batches: (LogEvent[] | undefined)[]): string[] {
  const ends = new Ends();
  batches.forEach((events) => ends.take(events, 'ann'));
  return ends.news.map(({ id }) => id);
}

describe('standing grants that ended', () => {
  it('are told to who gave them, once, where others ended them or their time did', () => {
    const events = [recorded(1, 'a', 'ann', 'revoked', 'bob'), recorded(2, 'b', 'ann'), recorded(3, 'b', 'ann', 'expired')];
    expect(told([], events, events)).toEqual(['b', 'a']);
  });

  it('are no news to others, to whoever ended them, nor where they had before anybody signed in', () => {
    expect(told([], [recorded(1, 'a', 'bob', 'expired'), recorded(2, 'b', 'ann', 'revoked', 'ann')])).toEqual([]);
    expect(told([recorded(1, 'a', 'ann', 'expired')])).toEqual([]);
  });

  it('stay until they are put away', () => {
    const ends = new Ends();
    ends.take([], 'ann');
    ends.take([recorded(1, 'a', 'ann', 'revoked', 'bob')], 'ann');
    ends.take([], 'ann');
    const when = clockTime(AT);
    expect(ends.news.map(endOf)).toEqual([`“grasp object” of mug_1 by planner in workcell-1 (${when}, revoked by bob)`]);
    ends.putAway();
    expect(ends.news).toEqual([]);
  });

  it('say why', () => {
    const words = ['expired', 'estop', 'unheard_of'].map((code) => endOf(recorded(1, 'a', 'ann', code).body['grant'] as never).split(', ')[1]);
    expect(words).toEqual(['ran out)', 'ended by the emergency stop)', 'ended)']);
  });
});
