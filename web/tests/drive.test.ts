import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';

describe('a lease that is remembered across a reload', () => {
  let stored: Map<string, string>;
  let grant: ((alone: boolean) => void)[];
  let leaving: (() => void)[];
  const settled = (): Promise<void> => new Promise((resolve) => setTimeout(resolve));

  beforeEach(() => {
    stored = new Map([['reins.lease', 'lease_1']]);
    grant = [];
    leaving = [];
    vi.resetModules();
    vi.stubGlobal('addEventListener', (_: 'pagehide', leave: () => void) => leaving.push(leave));
    vi.stubGlobal('sessionStorage', { getItem: (key: string) => stored.get(key) ?? null, setItem: (key: string, value: string) => stored.set(key, value), removeItem: (key: string) => stored.delete(key) });
    const request = (_: string, __: object, held: () => Promise<void>): Promise<void> =>
      new Promise((resolve, reject) =>
        grant.push((alone) => {
          if (alone) void held().then(resolve);
          else reject(new Error('held elsewhere'));
        }),
      );
    vi.stubGlobal('navigator', { locks: { request } });
  });
  afterEach(() => {
    vi.useRealTimers();
    vi.unstubAllGlobals();
  });

  it.each([[true, 'lease_1', 'lease_1'], [false, null, undefined]])('is this window’s where it alone has it: %s', async (alone, lease, kept) => {
    const { drive } = await import('../src/lib/state/drive.svelte');
    grant[0]?.(alone);
    await settled();
    expect([drive.lease, stored.get('reins.lease')]).toEqual([lease, kept]);
  });

  it('takes nothing from one that was taken before that was known, nor comes back to who has left', async () => {
    const { drive } = await import('../src/lib/state/drive.svelte');
    drive.took('lease_2');
    grant[0]?.(false);
    await settled();
    expect([drive.lease, stored.get('reins.lease')]).toEqual(['lease_2', 'lease_2']);
    stored.set('reins.lease', 'lease_1');
    vi.resetModules();
    const { drive: another } = await import('../src/lib/state/drive.svelte');
    another.leave();
    grant.at(-1)?.(true);
    await settled();
    expect(another.lease).toBe(null);
  });

  it('is had as long as the page where nothing may be stored', async () => {
    const denied = (): never => {
      throw new DOMException('denied', 'SecurityError');
    };
    vi.stubGlobal('sessionStorage', { getItem: denied, setItem: denied, removeItem: denied });
    const { drive } = await import('../src/lib/state/drive.svelte');
    drive.took('lease_1');
    leaving[0]?.();
    expect(drive.lease).toBe('lease_1');
    drive.leave();
    expect(drive.lease).toBe(null);
  });

  it('numbers its commands upwards, whatever the clock does between them and over a reload', async () => {
    vi.useFakeTimers({ toFake: ['Date'] });
    const { drive } = await import('../src/lib/state/drive.svelte');
    grant[0]?.(true);
    await settled();
    const first = drive.next();
    vi.setSystemTime(Date.now() - 3_600_000);
    expect(drive.next()).toBeGreaterThan(first);
    leaving[0]?.();
    const last = drive.next(); // what a page lets go of as it is left
    vi.resetModules();
    const { drive: reloaded } = await import('../src/lib/state/drive.svelte');
    expect(reloaded.next()).toBeGreaterThan(last);
  });

  it('is for nothing to drive where no cell is known: the panel does not open, and closes where it was open', async () => {
    const { drive } = await import('../src/lib/state/drive.svelte');
    drive.toggle(null);
    expect([drive.open, drive.toggles(null)]).toEqual([false, false]);
    drive.toggle('workcell-1');
    expect([drive.open, drive.toggles(null)]).toEqual([true, true]);
    drive.toggle(null);
    expect(drive.open).toBe(false);
  });
});
