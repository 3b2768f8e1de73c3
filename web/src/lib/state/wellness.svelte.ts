import type { Api } from '../api/client';
import { sentence } from '../format/quoted';

const EVERY_MS = 5_000;
/** What of a server's health keeps robots from moving, in words; the rest is for whoever runs the server. */
const WORDS: Record<string, string> = {
  record: 'The log is damaged, so nothing launches.',
  store: 'Nothing can be recorded, so nothing launches.',
  background: 'A part of the server has broken, so every cell holds.',
};

export interface Trouble {
  part: string;
  words: string;
  why: string;
}

/** Returns what of a server's health an operator has to know, the gravest first. */
export function troublesOf(broken: Record<string, string | null>): Trouble[] {
  return Object.entries(WORDS)
    .filter(([part]) => part in broken)
    .map(([part, words]) => ({ part, words, why: broken[part] == null ? '' : sentence(broken[part]) }));
}

/** The script of a page of the console, as the page names it; null where that is none of them, as what a proxy wants one to sign in by. */
export function scriptOf(page: string): string | null {
  return /<script type="module"[^>]* src="([^"]+)"/.exec(page)?.[1] ?? null;
}

/** How the server says it is, asked now and then: no event tells it, least of all where none can be recorded. */
export class Wellness {
  troubles = $state.raw<Trouble[]>([]);
  /** Whether the server hands out another console than this page, as after a change of its version. */
  outdated = $state(false);

  /** Looks whether what the server hands out is the page whose script is `own`; returns whether it handed out any. Without an answer it is what it was. */
  async compare(api: Pick<Api, 'page'>, own: string | null): Promise<boolean> {
    const served = scriptOf(await api.page().catch(() => ''));
    if (served !== null) this.outdated = served !== own;
    return served !== null;
  }

  /**
   * Asks until the returned function is called, which is while the link is up: what was so before it broke off may be over.
   * Whether the page whose script is `own` is still the one that is handed out is asked until that is known.
   */
  watch(api: Pick<Api, 'health' | 'page'>, own: string | null): () => void {
    let timer: ReturnType<typeof setTimeout> | undefined;
    let over = false;
    let compared = false;
    this.troubles = [];
    const ask = async (): Promise<void> => {
      const said = await api.health().catch(() => null);
      compared ||= await this.compare(api, own);
      if (over) return;
      if (said !== null) this.troubles = troublesOf(said.broken);
      timer = setTimeout(() => void ask(), EVERY_MS);
    };
    void ask();
    return () => {
      over = true;
      clearTimeout(timer);
    };
  }
}
