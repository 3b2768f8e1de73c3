import type { Escalation, Risk } from '../api/documents';
import { countdown } from '../format/time';

const RISKS: Record<Risk, number> = { critical: 3, high: 2, medium: 1, low: 0 };
export const LAST_CALL_MS = 30_000;

export function leftMs(escalation: Escalation, nowMs: number): number | null {
  return escalation.expires_at === null ? null : Date.parse(escalation.expires_at) - nowMs;
}

export function iApproved(escalation: Escalation, me: string | null): boolean {
  return me !== null && escalation.approvals.some((approval) => approval.by === me);
}

/**
 * Orders questions by what a person should look at first: what I can still answer; what is about to lapse; a robot
 * that is held in mid-motion; the higher risk; the nearer deadline.
 */
export function byUrgency(nowMs: number, me: string | null): (a: Escalation, b: Escalation) => number {
  const key = (item: Escalation): number[] => [...classOf(item, nowMs, me), leftMs(item, nowMs) ?? Number.MAX_SAFE_INTEGER];
  return (a, b) => {
    const left = key(a);
    const right = key(b);
    const at = left.findIndex((value, k) => value !== right[k]);
    return at === -1 ? a.id.localeCompare(b.id) : (left[at] ?? 0) - (right[at] ?? 0);
  };
}

function classOf(item: Escalation, nowMs: number, me: string | null): number[] {
  const left = leftMs(item, nowMs) ?? Number.MAX_SAFE_INTEGER;
  return [iApproved(item, me) ? 1 : 0, left < LAST_CALL_MS ? 0 : 1, item.kind === 'approval' ? 1 : 0, -RISKS[item.risk]];
}

/** Those of another class than the one that is open, and before it: a second that is left less makes nothing more urgent. */
export function graverThan(sorted: readonly Escalation[], current: string | null, nowMs: number, me: string | null): Escalation[] {
  const at = sorted.findIndex((item) => item.id === current);
  const open = sorted[at];
  if (open === undefined) return [];
  const own = String(classOf(open, nowMs, me));
  return sorted.slice(0, at).filter((item) => String(classOf(item, nowMs, me)) !== own);
}

/** The question after the one that is open, in the order they are shown; null where it is the only one. */
export function nextOf(sorted: readonly Escalation[], current: string | null): Escalation | null {
  const others = sorted.filter((item) => item.id !== current);
  const at = sorted.findIndex((item) => item.id === current);
  return sorted.slice(at + 1).find((item) => item.id !== current) ?? others[0] ?? null;
}

/** What lapses first of what is not open, and can still be answered by this person. */
export function soonestOf(sorted: readonly Escalation[], current: string | null, nowMs: number, me: string | null): Escalation | null {
  const left = (item: Escalation): number => leftMs(item, nowMs) ?? Infinity;
  const others = sorted.filter((item) => item.id !== current && !iApproved(item, me) && item.expires_at !== null);
  return others.sort((a, b) => left(a) - left(b))[0] ?? null;
}

/** The questions that this person can still answer: how many, and what time the first of them has left, ms. */
export interface Outstanding {
  count: number;
  leftMs: number | null;
}

export function outstandingOf(asked: readonly Escalation[], nowMs: number, me: string | null): Outstanding {
  const first = soonestOf(asked, null, nowMs, me);
  return { count: asked.filter((item) => !iApproved(item, me)).length, leftMs: first === null ? null : leftMs(first, nowMs) };
}

/** `2 questions`. */
export function questionsWords({ count }: Outstanding): string {
  return `${count} question${count === 1 ? '' : 's'}`;
}

/** What a tab is called, so that what waits is seen from another one; null: that is not known. */
export function tabTitle(waits: Outstanding | null): string {
  if (waits === null || waits.count === 0) return 'Reins console';
  return `(${waits.count}${waits.leftMs === null ? '' : `, ${countdown(waits.leftMs)}`}) Reins console`;
}

/**
 * Says which question the keys A and D are about. The one that was current stays so until it is answered, whatever
 * more urgent comes in: a key that is on its way must not meet another question.
 */
export function currentOf(sorted: readonly Escalation[], before: string | null): string | null {
  return sorted.some((item) => item.id === before) ? before : (sorted[0]?.id ?? null);
}
