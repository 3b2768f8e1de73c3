import type { LogEvent } from '../api/documents';
import { eventLine, type Known, type Line } from '../format/events';
import type { Tone } from '../format/status';
import { outside, type Placed, type Timeline } from './timeline';

/** An event of a trace with its place in time, and in words. */
export interface Told extends Placed {
  line: Line;
}

/** Marks nearer to each other than this share of the axis are drawn as one, where they say the same. */
const APART = 1 / 500;

export interface Mark {
  key: string;
  /** Share of the axis, %. */
  at: number;
  tone: Tone;
}

/** Puts every event of a trace in words, in one pass: it may hold thousands. */
export function linesOf(events: readonly LogEvent[], known: Omit<Known, 'turnedAway'>): Line[] {
  const away = turnedAwayIn(events);
  return events.map((event) => eventLine(event, { ...known, turnedAway: ({ seq }) => away.has(seq) }));
}

/** The verdicts of policy on what admission, which is recorded just before, had refused or put off. */
function turnedAwayIn(events: readonly LogEvent[]): Set<number> {
  const refused = new Map<string | null, boolean>();
  const away = new Set<number>();
  for (const { kind, seq, invocation, body } of events) {
    if (kind === 'admission') refused.set(invocation, body['outcome'] !== 'accept');
    else if (kind === 'policy' && refused.get(invocation) === true) away.add(seq);
  }
  return away;
}

/** What is marked on the slider: whatever is not quiet, where a finger could tell it from its neighbours. */
export function marksOf(timeline: Timeline, lines: readonly Line[]): Mark[] {
  const { axis, placed } = timeline;
  const marks = new Map<string, Mark>();
  for (const [k, { atS }] of placed.entries()) {
    const tone = lines[k]?.tone ?? 'quiet';
    if (tone === 'quiet' || outside(timeline, atS) !== '') continue;
    const share = axis.place(atS) / axis.length;
    const key = `${Math.round(share / APART)} ${tone}`;
    if (!marks.has(key)) marks.set(key, { key, at: 100 * share, tone });
  }
  return [...marks.values()];
}
