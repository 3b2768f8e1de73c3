import { describe, expect, it } from 'vitest';
import type { LogEvent } from '../src/lib/api/documents';
import { linesOf, marksOf } from '../src/lib/audit/lines';
import { eventAt, timelineOf } from '../src/lib/audit/timeline';
import { eventLine, turnedAway } from '../src/lib/format/events';

const START_MS = Date.parse('2026-03-01T09:30:00.000Z');
const event = (seq: number, kind: string, body: LogEvent['body'] = {}, invocation = 'inv_1'): LogEvent => ({
  seq, at: new Date(START_MS + seq * 40).toISOString(), kind, invocation, actor: 'x', body,
});
const KNOWN = { inputs: () => ({}), grant: () => null };
const MANY = 20_000;
const KINDS = [
  (seq: number) => event(seq, 'admission', { outcome: seq % 3 === 0 ? 'defer' : 'accept' }, `inv_${seq % 7}`),
  (seq: number) => event(seq, 'policy', { outcome: 'allow', changes: [] }, `inv_${seq % 7}`),
  (seq: number) => event(seq, 'alert', { signal: 'STOP', rule: 'separation_m', tick: seq * 4 }),
  (seq: number) => event(seq, 'human', { op: 'pause' }),
] as const;
const trace = (count: number): LogEvent[] => Array.from({ length: count }, (_, k) => (KINDS[k % KINDS.length] ?? KINDS[0])(k + 1));

describe('a trace in words', () => {
  it('says of each event what is said of it alone, of what was turned away too', () => {
    const events = trace(400);
    const alone = events.map((one) => eventLine(one, { ...KNOWN, turnedAway: (verdict) => turnedAway(events, verdict) }));
    expect(linesOf(events, KNOWN)).toEqual(alone);
    expect(alone.filter(({ text }) => text === 'Policy alone would allow it').length).toBeGreaterThan(10);
    expect(alone.filter(({ text }) => text === 'Allowed as proposed').length).toBeGreaterThan(10);
  });

  it('takes no longer for each event of many than of few', () => {
    const events = trace(MANY);
    const beganMs = performance.now();
    const lines = linesOf(events, KNOWN);
    const timeline = timelineOf(events, null);
    for (let k = 0; k < MANY; k += 1) eventAt(timeline.placed, timeline.toS);
    expect(performance.now() - beganMs).toBeLessThan(4_000);
    expect(marksOf(timeline, lines).length).toBeLessThan(1_600);
  });
});

describe('the marks of a slider', () => {
  it('leaves out what is quiet, and what lies where the same is marked', () => {
    const events = [event(1, 'launch', { permit: 'p', tick: 0 }), ...trace(400).map((one) => ({ ...one, seq: one.seq + 1 })), event(500, 'outcome', { outcome: 'failed', tick: 2_000 })];
    const timeline = timelineOf(events, null);
    const lines = linesOf(events, KNOWN);
    const marks = marksOf(timeline, lines);
    expect(new Set(marks.map(({ key }) => key)).size).toBe(marks.length);
    expect(marks.map(({ tone }) => tone)).not.toContain('quiet');
    expect(marks[0]).toEqual({ key: '0 plain', at: 0, tone: 'plain' });
    expect(marks.at(-1)?.at).toBeCloseTo(100);
    expect(marksOf(timeline, lines.slice(0, 1)).length).toBe(1);
  });
});

describe('a timeline of two clocks', () => {
  it('goes by the first moment that is not before, also where the wall clock was set back', () => {
    const at = (afterMs: number, body: LogEvent['body'] = {}): LogEvent => ({ ...event(1, 'alert', body), at: new Date(START_MS + afterMs).toISOString() });
    const events = [at(0, { tick: 0 }), at(10_000, { tick: 100 }), at(4_000, { tick: 200 }), at(20_000, { tick: 300 }), at(5_000)];
    expect(timelineOf(events.slice(-1).concat(events.slice(0, 4)), null).placed[0]?.atS).toBeCloseTo(0.5); // between the first two
  });
});
