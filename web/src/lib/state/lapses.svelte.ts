import type { Escalation, Json, LogEvent } from '../api/documents';

/** A question whose time ran out. */
export interface Lapse {
  asked: Escalation;
  at: string;
}

/** So many are kept until they are put away; of older ones only the record tells. */
const KEPT = 100;

const questionOf = (body: Json | undefined): Escalation | null => (typeof body === 'object' && body !== null && 'id' in body ? (body as unknown as Escalation) : null);

/** What lapsed since somebody signed in here, on whatever page they were, until they put it away; the newest first. */
export class Lapses {
  news: readonly Lapse[] = $state.raw([]);
  /** The event up to which it is known; null before the first. */
  private seq: number | null = null;

  /** Takes events as they come, those of a snapshot as well: what was recorded before the first one is no news. */
  take(events: readonly LogEvent[] | undefined): void {
    const known = this.seq;
    const fresh = (events ?? []).filter(({ seq }) => seq > (known ?? -1));
    this.seq = fresh.reduce((most, { seq }) => Math.max(most, seq), known ?? 0);
    if (known === null) return;
    const lapsed = fresh.flatMap(({ body, at }) => {
      const asked = questionOf(body['escalation']);
      return asked?.status === 'expired' && !this.news.some((one) => one.asked.id === asked.id) ? [{ asked, at }] : [];
    });
    if (lapsed.length > 0) this.news = [...lapsed.reverse(), ...this.news].slice(0, KEPT);
  }

  putAway(): void {
    this.news = [];
  }
}
