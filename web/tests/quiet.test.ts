import { describe, expect, it } from 'vitest';
import { Quiet } from '../src/lib/state/quiet';

/** Looks every 100 ms, with a frame every so often until frames stop; returns for how long after the last it was not told. */
function toldAfterMs(everyMs: number, quiet = new Quiet()): number {
  let nowMs = 0;
  quiet.look(nowMs);
  quiet.frame();
  for (let k = 0; k < 20; k += 1) {
    for (const next = nowMs + everyMs; nowMs < next; ) {
      nowMs = Math.min(next, nowMs + 100);
      expect(quiet.look(nowMs)).toBe(false);
    }
    quiet.frame();
  }
  const last = nowMs;
  while (!quiet.look((nowMs += 100)) && nowMs < last + 10_000);
  return nowMs - last;
}

describe('a cell whose pictures stay away', () => {
  it('is told within 0.8 s where they came quickly', () => {
    expect(toldAfterMs(33)).toBeLessThanOrEqual(800);
  });

  it('is waited for longer where they come seldom, and never much longer than two seconds', () => {
    expect(toldAfterMs(500)).toBeGreaterThan(900);
    expect(toldAfterMs(500)).toBeLessThanOrEqual(1_200);
    expect(toldAfterMs(590)).toBeLessThanOrEqual(2_100);
  });

  it('is the present again with the next picture', () => {
    const quiet = new Quiet();
    toldAfterMs(33, quiet);
    quiet.frame();
    expect(quiet.look(20_000)).toBe(false);
  });

  it('is not told by a page that was busy, asleep or hidden itself', () => {
    const quiet = new Quiet();
    quiet.frame();
    expect(quiet.look(0)).toBe(false);
    for (const atMs of [30_000, 31_000, 32_000]) expect(quiet.look(atMs)).toBe(false); // a hidden page's timers come once a second
  });

  it('is not told of one of which none has come', () => {
    const quiet = new Quiet();
    for (let atMs = 0; atMs < 5_000; atMs += 100) expect(quiet.look(atMs)).toBe(false);
    quiet.frame();
    quiet.anew();
    for (let atMs = 5_000; atMs < 10_000; atMs += 100) expect(quiet.look(atMs)).toBe(false);
  });
});
