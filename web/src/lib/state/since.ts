import type { LogEvent } from '../api/documents';

/** What was recorded since somebody signed in here, once each. */
export class Since {
  /** The event up to which it is known; null before the first. */
  private seq: number | null = null;

  /** Takes events as they come, those of a snapshot as well: what was recorded before the first one is no news. A log that was put back begins anew. */
  fresh(events: readonly LogEvent[] | undefined): LogEvent[] {
    if ((events?.at(-1)?.seq ?? Infinity) < (this.seq ?? 0)) this.seq = null;
    const known = this.seq;
    const fresh = (events ?? []).filter(({ seq }) => seq > (known ?? -1));
    this.seq = fresh.reduce((most, { seq }) => Math.max(most, seq), known ?? 0);
    return known === null ? [] : fresh;
  }
}
