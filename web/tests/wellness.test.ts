import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import { scriptOf, troublesOf, Wellness } from '../src/lib/state/wellness.svelte';

describe('how the server is', () => {
  beforeEach(() => void vi.useFakeTimers());
  afterEach(() => void vi.useRealTimers());

  const OWN = '/assets/index-1.js';
  const page = (script: string) => () => Promise.resolve(`<head><script type="module" crossorigin src="${script}"></script></head>`);

  it('is told where it keeps robots from moving, the gravest first', () => {
    const found = troublesOf({ store: 'no space left', record: 'the bytes of event `25` were altered', rows: 'of no concern here' });
    expect(found.map(({ part, why }) => [part, why])).toEqual([['record', 'The bytes of event “25” were altered.'], ['store', 'No space left.']]);
  });

  it('is asked again and again, and no more once the console has ended', async () => {
    const answers = [{ status: 'degraded', broken: { record: 'damaged' } }, null, { status: 'ok', broken: {} }];
    const health = vi.fn(() => {
      const next = answers.shift() ?? null;
      return next === null ? Promise.reject(new Error('away')) : Promise.resolve(next);
    });
    const wellness = new Wellness();
    const end = wellness.watch({ health, page: page(OWN) }, OWN);
    await vi.advanceTimersByTimeAsync(1);
    expect(wellness.troubles.map(({ part }) => part)).toEqual(['record']);
    await vi.advanceTimersByTimeAsync(5_000);
    expect(wellness.troubles).toHaveLength(1); // it did not answer: what it said last stands
    await vi.advanceTimersByTimeAsync(5_000);
    expect(wellness.troubles).toEqual([]);
    end();
    await vi.advanceTimersByTimeAsync(20_000);
    expect(health).toHaveBeenCalledTimes(3);
  });

  it('is not what it was before the link broke off, and is asked at once when that is back', async () => {
    const health = vi.fn(() => Promise.resolve({ status: 'degraded', broken: { store: 'no space left' } }));
    const wellness = new Wellness();
    wellness.watch({ health, page: page(OWN) }, OWN)();
    const end = wellness.watch({ health, page: page(OWN) }, OWN);
    await vi.advanceTimersByTimeAsync(1);
    expect(wellness.troubles).toHaveLength(1);
    end();
    wellness.watch({ health: () => new Promise(() => undefined), page: page(OWN) }, OWN);
    expect([wellness.troubles, health.mock.calls.length]).toEqual([[], 2]);
  });

  it('is of another version where it hands out another page, and not where it does not answer or a proxy does', async () => {
    const wellness = new Wellness();
    const told = async (served: () => Promise<string>): Promise<boolean> => {
      await wellness.compare({ page: served }, OWN);
      return wellness.outdated;
    };
    expect(await told(page(OWN))).toBe(false);
    expect(await told(page('/assets/index-2.js'))).toBe(true);
    expect(await told(() => Promise.reject(new Error('away')))).toBe(true);
    expect(await told(page(OWN))).toBe(false);
    expect(await told(() => Promise.resolve('<form>Sign in</form>'))).toBe(false);
    expect(scriptOf('<script type="module" src="/src/main.ts"></script>')).toBe('/src/main.ts');
  });

  it('is asked which page it hands out until it has said so, once for each link', async () => {
    const answers = ['', '<form>Sign in</form>'];
    const served = vi.fn(() => (answers.length > 0 ? Promise.resolve(answers.shift() ?? '') : page('/assets/index-2.js')()));
    const wellness = new Wellness();
    const end = wellness.watch({ health: () => Promise.resolve({ status: 'ok', broken: {} }), page: served }, OWN);
    await vi.advanceTimersByTimeAsync(6_000);
    expect(wellness.outdated).toBe(false);
    await vi.advanceTimersByTimeAsync(5_000);
    expect(wellness.outdated).toBe(true);
    await vi.advanceTimersByTimeAsync(20_000);
    expect(served).toHaveBeenCalledTimes(3);
    end();
  });
});
