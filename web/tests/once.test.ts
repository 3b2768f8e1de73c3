import { describe, expect, it } from 'vitest';
import { oneAtATime } from '../src/lib/state/once';

describe('what is done one at a time', () => {
  it('is done to its end, and once more for all who asked meanwhile', async () => {
    const ends: (() => void)[] = [];
    const act = oneAtATime(() => new Promise<void>((end) => ends.push(end)));
    const first = act();
    const more = [act(), act()];
    expect(ends.length).toBe(1);
    ends[0]?.();
    await Promise.resolve();
    expect(ends.length).toBe(2);
    ends[1]?.();
    await Promise.all([first, ...more]);
    expect(ends.length).toBe(2);
    void act();
    expect(ends.length).toBe(3);
  });

  it('is done again also where it failed', async () => {
    let times = 0;
    const act = oneAtATime(() => {
      times += 1;
      return times === 1 ? Promise.reject(new Error('no')) : Promise.resolve();
    });
    await expect(act()).rejects.toThrow('no');
    await act();
    expect(times).toBe(2);
  });
});
