/** Lets so many through at once; the others wait, in the order they came. */
export class Gate {
  private inside = 0;
  private readonly waiting: (() => void)[] = [];

  constructor(private readonly most: number) {}

  async through<T>(call: () => Promise<T>): Promise<T> {
    if (this.inside === this.most) await new Promise<void>((resolve) => this.waiting.push(resolve));
    else this.inside += 1;
    try {
      return await call();
    } finally {
      const next = this.waiting.shift();
      if (next === undefined) this.inside -= 1;
      else next(); // takes over the place
    }
  }
}
