/** How far the person has been told of questions that lapsed: whoever comes back from another page is told there. */
class Lapses {
  /** The event up to which they know; null before the first snapshot. */
  seq = $state<number | null>(null);
  told: ReadonlySet<string> = $state.raw(new Set<string>());

  /** Nothing that is recorded by now is news any more. */
  upTo(seq: number): void {
    this.seq = seq;
    this.told = new Set();
  }

  tell(id: string): void {
    if (!this.told.has(id)) this.told = new Set([...this.told, id]);
  }
}

export const lapses = new Lapses();
