import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import { LEAST_MS, MOST_MS, Pace, SHARE } from '../src/lib/state/pace';

describe('the pace of drawing', () => {
  const COST_MS = 50;
  let drawn: number[];
  let pace: Pace;

  beforeEach(() => {
    vi.useFakeTimers({ now: 0 });
    drawn = [];
    const cost = (): Promise<void> => new Promise((resolve) => setTimeout(resolve, COST_MS));
    pace = new Pace(() => drawn.push(Date.now()), cost, () => Date.now());
  });
  afterEach(() => {
    vi.useRealTimers();
  });

  it('draws at once after a quiet moment, and once for what comes together', async () => {
    pace.ask();
    pace.ask();
    expect(drawn).toEqual([0]);
    await vi.advanceTimersByTimeAsync(10_000);
    expect(drawn).toEqual([0, SHARE * COST_MS]);
    pace.ask();
    expect(drawn.at(-1)).toBe(10_000);
  });

  it('leaves most of the time to whoever presses a key, whatever floods in', async () => {
    for (let at = 0; at < 4_000; at += 5) {
      pace.ask();
      await vi.advanceTimersByTimeAsync(5);
    }
    expect(drawn.length * COST_MS).toBeLessThanOrEqual(4_000 / SHARE + COST_MS);
    expect(drawn.length).toBeGreaterThan(4_000 / SHARE / COST_MS / 2);
    expect(LEAST_MS).toBeLessThan(SHARE * COST_MS);
  });

  it('keeps its pace after one drawing during which the page was busy with something else', async () => {
    const costs = [COST_MS, 20 * COST_MS, COST_MS];
    const held = new Pace(() => drawn.push(Date.now()), () => new Promise((resolve) => setTimeout(resolve, costs.shift() ?? COST_MS)), () => Date.now());
    for (let at = 0; at < 2_000; at += 10) {
      held.ask();
      await vi.advanceTimersByTimeAsync(10);
    }
    const [, second = 0, third = Infinity] = drawn;
    expect(third - second).toBeLessThanOrEqual(20 * COST_MS + SHARE * COST_MS);
  });

  it('draws again soon on a slow computer: nothing old is shown as the present', async () => {
    const slow = (): Promise<void> => new Promise((resolve) => setTimeout(resolve, 800));
    const busy = new Pace(() => drawn.push(Date.now()), slow, () => Date.now());
    for (let at = 0; at < 2_500; at += 50) {
      busy.ask();
      await vi.advanceTimersByTimeAsync(50);
    }
    expect(drawn).toEqual([0, 800 + MOST_MS, 2 * (800 + MOST_MS)]);
  });

  it('says how old what is shown will be once what waits is drawn', async () => {
    expect(pace.behindMs()).toBe(0);
    pace.ask();
    await vi.advanceTimersByTimeAsync(COST_MS);
    expect(pace.behindMs()).toBe(0);
    pace.ask(Date.now() - 500); // it waited before it was taken
    pace.ask();
    expect(pace.behindMs()).toBe(500 + COST_MS);
    await vi.advanceTimersByTimeAsync(100);
    expect(pace.behindMs()).toBe(600 + COST_MS);
    await vi.advanceTimersByTimeAsync(SHARE * COST_MS);
    expect(pace.behindMs()).toBe(0);
  });

  it('goes on after a drawing that failed', async () => {
    let fails = true;
    const failing = new Pace(() => {
      drawn.push(Date.now());
      if (fails) throw new Error('no such thing');
    }, () => Promise.resolve());
    const failed = vi.fn();
    process.once('unhandledRejection', failed);
    failing.ask();
    await vi.advanceTimersByTimeAsync(0);
    fails = false;
    failing.ask();
    expect(drawn.length).toBe(2);
  });
});
