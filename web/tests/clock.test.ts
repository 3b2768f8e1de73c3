import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';

beforeEach(() => {
  vi.useFakeTimers();
  vi.resetModules();
});
afterEach(() => vi.useRealTimers());

it('tells the server’s time, and goes on telling it when this computer’s clock is set', async () => {
  const { clock } = await import('../src/lib/state/clock.svelte');
  const server = Date.parse('2026-11-22T10:00:00Z');
  clock.sync(server / 1000);
  for (const stepMs of [3_600_000, -7_200_000]) {
    vi.setSystemTime(Date.now() + stepMs);
    expect(clock.read()).toBe(server);
  }
  vi.advanceTimersByTime(250);
  expect([clock.read(), clock.nowMs]).toEqual([server + 250, server + 250]);
});

it('steps with what the server says where the page’s own timers are late, as those of a hidden one are', async () => {
  const { clock } = await import('../src/lib/state/clock.svelte');
  const server = Date.parse('2026-11-22T10:00:00Z');
  clock.sync(server / 1000);
  vi.clearAllTimers();
  vi.advanceTimersByTime(50_000);
  clock.sync((server + 50_000) / 1000);
  expect(clock.nowMs).toBe(server + 50_000);
});

it('is this computer’s until the server has said its own', async () => {
  const { clock } = await import('../src/lib/state/clock.svelte');
  expect(Math.abs(clock.read() - Date.now())).toBeLessThan(1_000);
});

describe('a computer that has slept, in which no clock but the one that is set has gone on', () => {
  const SERVER = Date.parse('2026-11-22T10:00:00Z');
  const HOUR_MS = 3_600_000;

  it('knows how long ago what is shown was so, though no link tells', async () => {
    const { clock } = await import('../src/lib/state/clock.svelte');
    clock.sync(SERVER / 1000);
    vi.setSystemTime(Date.now() + HOUR_MS);
    vi.advanceTimersByTime(2_000);
    expect(clock.nowMs).toBe(SERVER + HOUR_MS + 2_000);
    clock.sync((SERVER + HOUR_MS + 1_000) / 1000); // the server knows better
    expect(clock.read()).toBe(SERVER + HOUR_MS + 1_000);
  });

  it('is told from one whose clock was set by what the server goes on saying', async () => {
    const { clock } = await import('../src/lib/state/clock.svelte');
    clock.sync(SERVER / 1000);
    vi.setSystemTime(Date.now() + HOUR_MS);
    for (let ms = 200; ms <= 2_000; ms += 200) {
      vi.advanceTimersByTime(200);
      clock.sync((SERVER + ms) / 1000);
      expect(clock.read()).toBe(SERVER + ms);
    }
    vi.advanceTimersByTime(2_000);
    expect(clock.nowMs).toBe(SERVER + 4_000);
  });
});
