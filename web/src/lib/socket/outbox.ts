/** What there is to tell a page, one by one. */
interface Told {
  is: string;
}

/**
 * What waits for a page that takes it slower than it comes. It has all of that at once, as soon as it has taken what came
 * before: a page that draws for long after each word would fall behind by more with each, and show what was so long ago.
 */
export class Outbox<T extends Told> {
  private waiting: readonly T[] = [];
  private taking = false;

  /** `only`: of what is of this kind, the newest alone is worth telling. */
  constructor(
    private readonly send: (all: readonly T[]) => void,
    private readonly only: T['is'],
  ) {}

  put(one: T): void {
    const kept = one.is === this.only ? this.waiting.filter(({ is }) => is !== one.is) : this.waiting;
    this.waiting = [...kept, one];
    this.flush();
  }

  /** The page has taken what was sent last. */
  took(): void {
    this.taking = false;
    this.flush();
  }

  private flush(): void {
    if (this.taking || this.waiting.length === 0) return;
    this.taking = true;
    const all = this.waiting;
    this.waiting = [];
    this.send(all);
  }
}
