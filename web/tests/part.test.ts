import { describe, expect, it } from 'vitest';
import { Part } from '../src/lib/state/part';

const SAID = 'TypeError: Failed to fetch dynamically imported module: http://127.0.0.1:8000/assets/Fleet-abc.js';

/** A browser that cannot fetch a module so many times, and remembers each address that failed. */
function browser(failures: number, said: string): { asked: string[]; part: Part<string> } {
  const asked: string[] = [];
  const spent = new Set<string>();
  const ask = (address: string): Promise<string> => {
    asked.push(address);
    if (spent.has(address) || spent.size < failures) {
      spent.add(address);
      return Promise.reject(new TypeError(said));
    }
    return Promise.resolve('page');
  };
  return { asked, part: new Part(() => ask('own'), ask) };
}

describe('a part that comes later', () => {
  it('is asked for once where it comes', async () => {
    const { asked, part } = browser(0, SAID);
    expect(await part.fetch()).toBe('page');
    expect(asked).toEqual(['own']);
  });

  it('is asked for under another address each time, as a browser remembers what it could not fetch', async () => {
    const { asked, part } = browser(2, SAID);
    await expect(part.fetch()).rejects.toThrow();
    await expect(part.fetch()).rejects.toThrow();
    expect(await part.fetch()).toBe('page');
    expect(asked).toEqual(['own', 'http://127.0.0.1:8000/assets/Fleet-abc.js?1', 'http://127.0.0.1:8000/assets/Fleet-abc.js?2']);
  });

  it('is asked for as before where the browser does not say which address failed', async () => {
    const { asked, part } = browser(1, 'TypeError: Importing a module script failed.');
    await expect(part.fetch()).rejects.toThrow();
    await expect(part.fetch()).rejects.toThrow();
    expect(asked).toEqual(['own', 'own']);
  });
});
