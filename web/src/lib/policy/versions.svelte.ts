import { ApiError, type Api } from '../api/client';
import type { Comparison, Shadow, Version } from '../api/documents';

/** What the server says of versions, as this tab last heard it. */
export class Versions {
  items = $state.raw<Version[]>([]);
  next = $state<string | null>(null);
  active = $state<string | null>(null);
  why = $state('');
  trouble = $state<string | null>(null);
  private limit = 50;

  constructor(private readonly api: Pick<Api, 'versions'>) {}

  get inForce(): Version | null {
    return this.find(this.active);
  }

  find(digest: string | null): Version | null {
    return this.items.find((item) => item.digest === digest) ?? null;
  }

  async refresh(): Promise<void> {
    try {
      const found = await this.api.versions(this.limit);
      this.items = found.items;
      this.next = found.next === null ? null : String(found.next);
      this.active = found.active;
      this.why = found.why;
      this.trouble = null;
    } catch (error) {
      this.trouble = said(error);
    }
  }

  async more(): Promise<void> {
    this.limit = Math.min(200, this.limit + 50);
    await this.refresh();
  }
}

/** What a version would change, and what it decides in the shadow; both belong to what is in force when they are asked. */
export class Closer {
  found = $state.raw<Comparison | null>(null);
  shadow = $state.raw<Shadow | null>(null);
  trouble = $state<string | null>(null);

  constructor(
    private readonly api: Pick<Api, 'comparison' | 'shadow'>,
    private readonly digest: string,
  ) {}

  /** Has it compared, until nobody wants to know any more. */
  async compare(until?: AbortSignal): Promise<void> {
    this.trouble = null;
    try {
      this.found = await this.api.comparison(this.digest, until);
    } catch (error) {
      if (until?.aborted !== true) this.trouble = said(error);
    }
  }

  async look(): Promise<void> {
    try {
      this.shadow = await this.api.shadow(this.digest);
    } catch (error) {
      this.trouble = said(error);
    }
  }
}

export function said(error: unknown): string {
  return error instanceof ApiError ? error.message : String(error);
}
