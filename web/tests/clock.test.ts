import { afterEach, beforeEach, expect, it, vi } from 'vitest';

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

it('is this computer’s until the server has said its own', async () => {
  const { clock } = await import('../src/lib/state/clock.svelte');
  expect(Math.abs(clock.read() - Date.now())).toBeLessThan(1_000);
});
