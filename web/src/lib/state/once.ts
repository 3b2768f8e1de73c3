/**
 * Does something that takes a while one at a time. Asked for meanwhile, however often, it is done once more behind that:
 * what comes faster than it can be read is read all the same.
 */
export function oneAtATime(act: () => Promise<void>): () => Promise<void> {
  let running: Promise<void> | null = null;
  let asked = 0;
  async function run(): Promise<void> {
    for (let done = NaN; done !== asked;) {
      done = asked;
      await act();
    }
  }
  return () => {
    asked += 1;
    running ??= run().finally(() => (running = null));
    return running;
  };
}
