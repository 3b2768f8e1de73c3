import type { Escalation, Json, LogEvent } from '../api/documents';

/** A question that nobody answered in time. */
export interface Lapse {
  asked: Escalation;
  at: string;
}

const questionOf = (body: Json | undefined): Escalation | null => (typeof body === 'object' && body !== null && 'id' in body ? (body as unknown as Escalation) : null);

/** The questions that lapsed after an event, the newest first; `told` are those of which the person was told by other words. */
export function lapsedSince(events: readonly LogEvent[], seq: number, told: ReadonlySet<string>): Lapse[] {
  const found = new Map<string, Lapse>();
  for (const event of events) {
    const asked = event.seq > seq ? questionOf(event.body['escalation']) : null;
    if (asked?.status === 'expired' && !told.has(asked.id)) found.set(asked.id, { asked, at: event.at });
  }
  return [...found.values()].reverse();
}
