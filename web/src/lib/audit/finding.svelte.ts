import { ApiError, type Api } from '../api/client';
import type { Invocation, LogEvent } from '../api/documents';
import { findEvents, findSessions, furtherBy, NOTHING_LOOKED_AT, NOTHING_WANTED, renewed, type Wanted } from './search';

export type Sought = 'sessions' | 'events';

/** What was looked for in the record, and what was found: of several answers the one to the newest question. */
export class Finding {
  /** What was asked for: what is still being typed filters nothing yet. */
  asked = $state.raw<Wanted>(NOTHING_WANTED);
  what = $state<Sought>('sessions');
  sessions = $state.raw<Invocation[]>([]);
  events = $state.raw<LogEvent[]>([]);
  next = $state.raw<string | number | null>(null);
  /** How far it was looked for. */
  looked = $state.raw(NOTHING_LOOKED_AT);
  /** Of events, which come first; sessions are listed by the newest. */
  newestFirst = $state(true);
  busy = $state(false);
  why = $state('');
  private turn = 0;
  private asking = new AbortController();
  private renewals = 0;

  constructor(private readonly api: Pick<Api, 'events' | 'invocations'>) {}

  get count(): number {
    return this.what === 'sessions' ? this.sessions.length : this.events.length;
  }

  /** Whether words are searched for. */
  get searched(): boolean {
    return this.asked.text.trim() !== '';
  }

  /** Looks for something else, or anew. */
  async look(what: Sought, wanted: Wanted): Promise<void> {
    this.what = what;
    this.asked = wanted;
    [this.sessions, this.events, this.next, this.looked] = [[], [], null, NOTHING_LOOKED_AT]; // none of it answers this
    await this.find(false);
  }

  /** Lists events by the other end. */
  async turnRound(): Promise<void> {
    this.newestFirst = !this.newestFirst;
    await this.look('events', this.asked);
  }

  async more(): Promise<void> {
    await this.find(true);
  }

  /** Reads the beginning of the list of sessions anew: what is listed is no less true if that fails. A search stays as it was answered. */
  async renew(): Promise<void> {
    if (this.what !== 'sessions' || this.searched || (this.busy && this.count === 0)) return; // it is on its way
    this.renewals += 1;
    const [turn, mine] = [this.turn, this.renewals];
    const found = await findSessions(this.api, this.asked, null).catch(() => null);
    if (found === null || found.why !== '' || turn !== this.turn || mine !== this.renewals) return;
    ({ items: this.sessions, next: this.next, looked: this.looked } = renewed({ items: this.sessions, next: this.next, looked: this.looked }, found));
  }

  /** Nobody waits for an answer any more. */
  leave(): void {
    this.asking.abort();
  }

  private async find(more: boolean): Promise<void> {
    this.asking.abort(); // a search goes through the log in many requests
    this.asking = new AbortController();
    this.turn += 1;
    const mine = this.turn;
    this.busy = true;
    try {
      const found = await (this.what === 'sessions' ? this.moreSessions(more) : this.moreEvents(more));
      if (mine !== this.turn) return;
      this.why = found();
    } catch (error) {
      if (mine === this.turn) this.why = error instanceof ApiError ? error.message : String(error);
    }
    if (mine === this.turn) this.busy = false;
  }

  /** Returns what puts the found ones on screen, if nothing else was asked for meanwhile, and says why there are no more of them. */
  private async moreSessions(more: boolean): Promise<() => string> {
    const from = more && typeof this.next === 'string' ? this.next : null;
    const found = await findSessions(this.api, this.asked, from, this.asking.signal);
    return () => {
      const before = from === null ? [] : this.sessions;
      this.sessions = [...before, ...found.items.filter(({ id }) => !before.some((listed) => listed.id === id))];
      this.next = found.next;
      this.looked = furtherBy(from === null ? NOTHING_LOOKED_AT : this.looked, found.looked);
      return found.why;
    };
  }

  private async moreEvents(more: boolean): Promise<() => string> {
    const from = more && typeof this.next === 'number' ? this.next : null;
    const found = await findEvents(this.api, this.asked, from, this.newestFirst, this.asking.signal);
    return () => {
      this.events = from === null ? found.items : [...this.events, ...found.items];
      this.next = found.next;
      this.looked = furtherBy(from === null ? NOTHING_LOOKED_AT : this.looked, found.looked);
      return found.why;
    };
  }
}
