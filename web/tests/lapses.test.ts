import { describe, expect, it } from 'vitest';
import type { Json, LogEvent } from '../src/lib/api/documents';
import { Lapses } from '../src/lib/state/lapses.svelte';
import { escalation } from './samples';

function recorded(seq: number, id: string, status: 'pending' | 'denied' | 'expired'): LogEvent {
  const body = { escalation: escalation({ id, status }) as unknown as Json };
  return { seq, kind: 'approval', at: `2026-11-22T10:00:0${seq}.000Z`, invocation: `inv_${id}`, actor: 'reins', body };
}

function told(...batches: (LogEvent[] | undefined)[]): string[] {
  const lapses = new Lapses();
  batches.forEach((events) => lapses.take(events));
  return lapses.news.map(({ asked }) => asked.id);
}

describe('questions that lapsed', () => {
  it('are no news where they did so before anybody signed in', () => {
    expect(told([recorded(1, 'a', 'expired')])).toEqual([]);
    expect(told([], [recorded(1, 'a', 'expired')])).toEqual(['a']);
  });

  it('are told once each, the newest first, and no other ends', () => {
    expect(told([], [recorded(1, 'a', 'expired'), recorded(2, 'b', 'pending')], [recorded(3, 'b', 'expired'), recorded(4, 'c', 'denied')])).toEqual(['b', 'a']);
    const again = [recorded(1, 'a', 'expired'), recorded(2, 'a', 'expired')];
    expect(told([], [again[0] as LogEvent], undefined, again)).toEqual(['a']); // a snapshot repeats what is known
  });

  it('are told of a log that was put back as well, from where it goes on', () => {
    expect(told([recorded(7, 'a', 'pending')], [recorded(3, 'a', 'expired')], [recorded(4, 'b', 'expired')])).toEqual(['b']);
  });

  it('stay until they are put away, whatever else is recorded', () => {
    const lapses = new Lapses();
    lapses.take([]);
    lapses.take([recorded(1, 'a', 'expired')]);
    for (let seq = 2; seq < 3_000; seq += 1) lapses.take([recorded(seq, `b${seq}`, 'denied')]);
    expect(lapses.news).toHaveLength(1);
    lapses.putAway();
    lapses.take([recorded(1, 'a', 'expired')]);
    expect(lapses.news).toEqual([]);
  });
});
