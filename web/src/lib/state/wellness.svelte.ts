import type { Api } from '../api/client';

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
    .map(([part, words]) => ({ part, words, why: broken[part] ?? '' }));
}

/** How the server says it is, asked now and then: no event tells it, least of all where none can be recorded. */
export class Wellness {
  troubles = $state.raw<Trouble[]>([]);

  /** Asks until the returned function is called, which is while the link is up: what was so before it broke off may be over. */
  watch(api: Pick<Api, 'health'>): () => void {
    let timer: ReturnType<typeof setTimeout> | undefined;
    let over = false;
    this.troubles = [];
    const ask = async (): Promise<void> => {
      const said = await api.health().catch(() => null);
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
