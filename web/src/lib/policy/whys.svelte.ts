import { SvelteMap } from 'svelte/reactivity';

/** The reasons that are being written for what is done to versions; they outlive the page that shows them, as long as the tab. */
export class Whys {
  private readonly written = new SvelteMap<string, string>();
  /** Who writes them. */
  private by: string | null = null;

  /** Are written by this person from now on: what somebody else left in the tab is no reason of theirs. */
  belongsTo(name: string): void {
    if (this.by !== null && this.by !== name) this.written.clear();
    this.by = name;
  }

  /** What is written for a version. */
  of(digest: string): string {
    return this.written.get(digest) ?? '';
  }

  write(digest: string, why: string): void {
    this.written.set(digest, why);
  }

  /** What was sent as it stands is done with; what was typed meanwhile is for what comes next. */
  sent(digest: string, why: string): void {
    if (this.of(digest) === why) this.written.delete(digest);
  }
}

export const whys = new Whys();
