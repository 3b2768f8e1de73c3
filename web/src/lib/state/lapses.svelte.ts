import type { Escalation, Json, LogEvent } from '../api/documents';
import { Since } from './since';

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
  private readonly since = new Since();

  take(events: readonly LogEvent[] | undefined): void {
    const lapsed = this.since.fresh(events).flatMap(({ body, at }) => {
      const asked = questionOf(body['escalation']);
      return asked?.status === 'expired' && !this.news.some((one) => one.asked.id === asked.id) ? [{ asked, at }] : [];
    });
    if (lapsed.length > 0) this.news = [...lapsed.reverse(), ...this.news].slice(0, KEPT);
  }

  putAway(): void {
    this.news = [];
  }
}
