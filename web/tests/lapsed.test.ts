import { describe, expect, it } from 'vitest';
import type { Json, LogEvent } from '../src/lib/api/documents';
import { lapsedSince } from '../src/lib/live/lapsed';
import { escalation } from './samples';

function recorded(seq: number, id: string, status: 'pending' | 'denied' | 'expired'): LogEvent {
  const body = { escalation: escalation({ id, status }) as unknown as Json };
  return { seq, kind: 'approval', at: `2026-11-22T10:00:0${seq}.000Z`, invocation: `inv_${id}`, actor: 'reins', body };
}

describe('questions that nobody answered', () => {
  const events = [recorded(1, 'a', 'expired'), recorded(2, 'b', 'pending'), recorded(3, 'b', 'expired'), recorded(4, 'c', 'denied'), recorded(5, 'd', 'expired'), recorded(6, 'd', 'expired')];
  const idsOf = (seq: number, ...told: string[]) => lapsedSince(events, seq, new Set(told)).map(({ asked }) => asked.id);

  it('are named once, the newest first, and no others', () => {
    expect(idsOf(0)).toEqual(['d', 'b', 'a']);
  });

  it('are news only after what the person knows', () => {
    expect(idsOf(1)).toEqual(['d', 'b']);
    expect(idsOf(6)).toEqual([]);
  });

  it('are not told twice', () => {
    expect(idsOf(0, 'd')).toEqual(['b', 'a']);
  });
});
