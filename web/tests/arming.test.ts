import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import { ARM_MS, Arming } from '../src/lib/keys/arming.svelte';
import { Presses } from '../src/lib/keys/presses';

let pressed: Presses;
let arming: Arming;
let end: () => void;

beforeEach(() => {
  vi.useFakeTimers();
  pressed = new Presses();
  arming = new Arming(pressed);
  end = pressed.onUp((what) => arming.letGo(what));
});
afterEach(() => {
  end();
  arming.end();
  vi.useRealTimers();
});

function shown(): void {
  arming.begin();
  arming.sight(true);
}

describe('a control that has just come', () => {
  it('takes a press once it has been in sight for a while', () => {
    arming.begin();
    vi.advanceTimersByTime(10 * ARM_MS);
    expect(arming.ready).toBe(false);
    arming.sight(true);
    vi.advanceTimersByTime(ARM_MS - 1);
    expect(arming.ready).toBe(false);
    vi.advanceTimersByTime(1);
    expect(arming.press('pointer 1')).toBe(true);
    arming.sight(false); // whoever scrolls it away and back has seen it
    expect(arming.ready).toBe(true);
  });

  it.each([150, 300, 600])('does not take the second press of a double one, %d ms later, and waits anew', (ms) => {
    shown();
    vi.advanceTimersByTime(ms);
    pressed.down('pointer 1');
    expect(arming.press('pointer 1')).toBe(false);
    vi.advanceTimersByTime(ARM_MS);
    expect(arming.ready).toBe(false); // it is still held
    pressed.up('pointer 1');
    vi.advanceTimersByTime(ARM_MS - 1);
    expect(arming.ready).toBe(false);
    vi.advanceTimersByTime(1);
    expect(arming.ready).toBe(true);
  });

  it('waits until what was held when it came is let go, and not for what is pressed elsewhere since', () => {
    pressed.down('key ArrowDown');
    shown();
    vi.advanceTimersByTime(10 * ARM_MS);
    pressed.down('key KeyA');
    pressed.up('key KeyA');
    expect(arming.ready).toBe(false);
    pressed.up('key ArrowDown');
    vi.advanceTimersByTime(ARM_MS / 2);
    pressed.down('key KeyA');
    pressed.up('key KeyA');
    vi.advanceTimersByTime(ARM_MS / 2);
    expect(arming.ready).toBe(true);
  });

  it('waits anew where it means something else, and counts for nothing once it is gone', () => {
    shown();
    vi.advanceTimersByTime(ARM_MS);
    arming.begin();
    expect(arming.ready).toBe(false);
    vi.advanceTimersByTime(ARM_MS);
    expect(arming.ready).toBe(true);
    arming.end();
    arming.begin();
    vi.advanceTimersByTime(10 * ARM_MS);
    expect(arming.ready).toBe(false);
  });

  it('waits for nothing that a window without the focus would never hear the end of', () => {
    pressed.down('key ArrowDown');
    pressed.down('pointer 1');
    shown();
    pressed.letGo();
    vi.advanceTimersByTime(ARM_MS);
    expect(arming.ready).toBe(true);
    expect(pressed.now.size).toBe(0);
  });
});
