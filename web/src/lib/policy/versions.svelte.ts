import { SvelteMap } from 'svelte/reactivity';
import { ApiError, type Api } from '../api/client';
import type { Comparison, Shadow, Version } from '../api/documents';
import { sentence } from '../format/quoted';
import { PickUnreadable } from './zip';

/** What the server answers where it has no version of a name, or what was asked for is no name of one. */
const NONE = new Set(['policy_unknown', 'request_invalid']);

/** What the server says of versions, as this tab last heard it. */
export class Versions {
  items = $state.raw<Version[]>([]);
  next = $state<string | null>(null);
  active = $state<string | null>(null);
  why = $state('');
  trouble = $state<string | null>(null);
  /** Whether the list has been asked for: before that, what it lacks is nothing to go by. */
  asked = $state(false);
  /** What was asked for by its digest, as the list does not reach to it; null where the server knows none. */
  private readonly apart = new SvelteMap<string, { turn: number; version: Version | null }>();
  private turn = 0;
  /** Of the list: how often it was asked for, and which of these answers is shown. */
  private listings = 0;
  private shown = 0;
  private limit = 50;

  constructor(private readonly api: Pick<Api, 'versions' | 'version'>) {}

  get inForce(): Version | null {
    return this.active === null ? null : (this.find(this.active) ?? null);
  }

  /** A version; null where the server says that there is none, undefined as long as nothing is known of it. */
  find(digest: string): Version | null | undefined {
    return this.items.find((item) => item.digest === digest) ?? this.apart.get(digest)?.version;
  }

  /** Asks for a version by its digest, unless the list holds it. */
  async seek(digest: string): Promise<void> {
    if (this.items.some((item) => item.digest === digest)) return;
    this.turn += 1;
    const mine = this.turn;
    try {
      this.hear(digest, mine, await this.api.version(digest));
    } catch (error) {
      if (error instanceof ApiError && NONE.has(error.code)) this.hear(digest, mine, null);
      else this.trouble = said(error);
    }
  }

  /** Asks for the list anew; what was asked for before the list that is shown tells nothing any more. */
  async refresh(): Promise<void> {
    this.listings += 1;
    const mine = this.listings;
    try {
      const found = await this.api.versions(this.limit);
      if (mine < this.shown) return;
      this.shown = mine;
      this.items = found.items;
      this.next = found.next === null ? null : String(found.next);
      this.active = found.active;
      this.why = found.why;
      this.trouble = null;
    } catch (error) {
      if (mine < this.shown) return;
      this.trouble = said(error);
    }
    this.asked = true;
  }

  async more(): Promise<void> {
    this.limit = Math.min(200, this.limit + 50);
    await this.refresh();
  }

  /** Keeps an answer, unless that to a later question has come before it. */
  private hear(digest: string, turn: number, version: Version | null): void {
    if (turn > (this.apart.get(digest)?.turn ?? 0)) this.apart.set(digest, { turn, version });
  }
}

/** What a version would change, and what it decides in the shadow; both belong to what is in force when they are asked. */
export class Closer {
  found = $state.raw<Comparison | null>(null);
  shadow = $state.raw<Shadow | null>(null);
  trouble = $state<string | null>(null);
  /** Why it is not known whether it decides in the shadow. */
  dark = $state<string | null>(null);
  /** Counts what was asked, or said, of the shadow: an older answer tells nothing any more. */
  private looks = 0;
  private seen = 0;

  constructor(
    private readonly api: Pick<Api, 'comparison' | 'shadow' | 'setShadow'>,
    private readonly digest: string,
  ) {}

  /** Has it compared, until nobody wants to know any more. What it was compared with before is in force no more. */
  async compare(until?: AbortSignal): Promise<void> {
    this.trouble = this.found = null;
    try {
      const found = await this.api.comparison(this.digest, until);
      if (until?.aborted !== true) this.found = found;
    } catch (error) {
      if (until?.aborted !== true) this.trouble = said(error);
    }
  }

  async look(): Promise<void> {
    const mine = (this.looks += 1);
    try {
      const found = await this.api.shadow(this.digest);
      if (mine < this.seen) return;
      this.seen = mine;
      this.shadow = found;
      this.dark = null;
    } catch (error) {
      if (mine >= this.seen) this.dark = said(error);
    }
  }

  /** Has it decide in the shadow, or not any more. What was asked of the shadow before that is answered tells nothing any more. */
  async setShadow(on: boolean, why: string): Promise<void> {
    const now = await this.api.setShadow(this.digest, on, why);
    this.looks += 1;
    this.seen = this.looks;
    this.shadow = now;
  }

  /** Asks once more for what could not be had. */
  async again(until?: AbortSignal): Promise<void> {
    const [compared, seen] = [this.trouble === null, this.dark === null];
    await Promise.all([compared ? null : this.compare(until), seen ? null : this.look()]);
  }
}

/** Why something did not come about, for a person. */
export function said(error: unknown): string {
  if (error instanceof PickUnreadable) return sentence(error.message);
  return error instanceof ApiError ? error.message : String(error);
}
