import { beforeEach, describe, expect, it } from 'vitest';
import { atOnce } from '../src/lib/keys/pressed';

describe('a stop', () => {
  let pressed: number;
  const stop = atOnce(() => (pressed += 1));
  const down = (timeStamp: number): void => stop.onpointerdown({ timeStamp } as PointerEvent);
  const up = (timeStamp: number): void => stop.onpointerup({ timeStamp } as PointerEvent);
  const click = (timeStamp: number, detail = 1): void => stop.onclick({ timeStamp, detail } as MouseEvent);

  beforeEach(() => {
    pressed = 0;
  });

  it('is pressed as the finger comes down, and not once more as it comes up', () => {
    down(5_000);
    expect(pressed).toBe(1);
    click(5_120);
    expect(pressed).toBe(1);
    down(5_200);
    click(5_300);
    expect(pressed).toBe(2);
  });

  it('is pressed once by a finger that stays on it, however long', () => {
    down(5_000);
    up(7_500);
    click(7_501);
    expect(pressed).toBe(1);
    click(9_000);
    expect(pressed).toBe(2);
  });

  it('is pressed by what presses without a finger', () => {
    click(10_000, 0);
    click(20_000);
    expect(pressed).toBe(2);
  });

  it.each(['Enter', ' '])('is pressed once by a key (%j) as that comes down, however long it is held', (key) => {
    let kept = 0;
    const keyed = (repeat: boolean): void => stop.onkeydown({ key, repeat, preventDefault: () => (kept += 1) } as unknown as KeyboardEvent);
    keyed(false);
    expect(pressed).toBe(1);
    for (let n = 0; n < 30; n += 1) keyed(true);
    expect([pressed, kept]).toEqual([1, 31]); // or the browser clicks as well
  });

  it('leaves every other key to the browser', () => {
    stop.onkeydown({ key: 'Tab', repeat: false, preventDefault: () => expect.fail() } as unknown as KeyboardEvent);
    expect(pressed).toBe(0);
  });
});
