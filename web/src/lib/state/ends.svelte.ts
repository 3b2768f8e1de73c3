import type { Grant, LogEvent } from '../api/documents';
import { Since } from './since';

/** So many are kept until they are put away; of older ones only the record tells. */
const KEPT = 100;

/** What of somebody's own grants ended otherwise than by their own word since they signed in here, until they put it away; the newest first. */
export class Ends {
  news: readonly Grant[] = $state.raw([]);
  private readonly since = new Since();

  take(events: readonly LogEvent[] | undefined, me: string | null): void {
    const ended = this.since.fresh(events).flatMap(({ kind, body }) => {
      const grant = kind === 'grant' && body['op'] === 'ended' ? (body['grant'] as unknown as Grant) : null;
      return grant !== null && grant.issued_by === me && grant.ended?.by !== me ? [grant] : [];
    });
    if (ended.length > 0) this.news = [...ended.reverse(), ...this.news].slice(0, KEPT);
  }

  putAway(): void {
    this.news = [];
  }
}
