import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';

describe('what a tab keeps over a reload', () => {
  const denied = (): never => {
    throw new DOMException('denied', 'SecurityError');
  };
  beforeEach(() => vi.resetModules());
  afterEach(() => vi.unstubAllGlobals());

  it('lasts as long as the page where nothing may be stored', async () => {
    vi.stubGlobal('sessionStorage', { getItem: denied, setItem: denied, removeItem: denied });
    const { tab } = await import('../src/lib/state/tab');
    tab.write('reins.cell', 'b');
    expect(tab.read('reins.cell')).toBe('b');
    tab.drop('reins.cell');
    expect(tab.read('reins.cell')).toBe(null);
  });

  it('is nothing older where there was no room for it', async () => {
    const stored = new Map([['reins.token', 'of another']]);
    vi.stubGlobal('sessionStorage', { getItem: (key: string) => stored.get(key) ?? null, setItem: denied, removeItem: (key: string) => stored.delete(key) });
    const { tab } = await import('../src/lib/state/tab');
    tab.write('reins.token', 'mine');
    expect([tab.read('reins.token'), stored.has('reins.token')]).toEqual(['mine', false]);
  });
});
