import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import { ARM_MS, Arming } from '../src/lib/keys/arming.svelte';
import { wasMoved, type Standing } from '../src/lib/keys/standing';
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

function at(top: number, scrolledY = 0, heights = 1_500): Standing {
  return { left: 10, top, right: 110, bottom: top + 44, scrolledX: 0, scrolledY, heights };
}

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

  it('does not wait for what opened a list, of which Firefox never says that it was let go', () => {
    const listeners: Record<string, (event: unknown) => void> = {};
    pressed.attach({ addEventListener: (type: string, listen: (event: unknown) => void) => (listeners[type] = listen) } as unknown as Window);
    const key = (tagName: string): void => listeners['keydown']?.({ key: ' ', code: 'Space', metaKey: false, target: { tagName } });
    key('SELECT');
    listeners['pointerdown']?.({ pointerId: 1, target: { tagName: 'SELECT' } });
    shown();
    vi.advanceTimersByTime(ARM_MS);
    expect(arming.ready).toBe(true);
    key('BUTTON');
    shown();
    vi.advanceTimersByTime(ARM_MS);
    expect(arming.ready).toBe(false);
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

  it('takes no finger for a while after the page moved it, but keys', () => {
    shown();
    vi.advanceTimersByTime(ARM_MS);
    arming.stood(at(100));
    arming.stood(at(148)); // a banner came above it
    expect(arming.press('key Enter')).toBe(true);
    vi.advanceTimersByTime(ARM_MS - 1);
    pressed.down('pointer 1');
    expect(arming.press('pointer 1', true)).toBe(false);
    expect(arming.ready).toBe(false); // nor the click that comes of it
    pressed.up('pointer 1');
    vi.advanceTimersByTime(ARM_MS);
    expect(arming.press('pointer 2', true)).toBe(true);
  });

  it('takes a finger where whoever scrolled moved it, or nothing did', () => {
    shown();
    vi.advanceTimersByTime(ARM_MS);
    for (const stands of [at(100), at(20, 80), at(25, 80), at(25, 80)]) arming.stood(stands);
    expect(arming.press('pointer 1', true)).toBe(true);
    for (const top of [28, 31, 34]) arming.stood(at(top, 80)); // little by little is moved, too
    expect(arming.press('pointer 1', true)).toBe(false);
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

describe('what the page moves', () => {
  it.each([
    ['by a banner above', at(100), at(148), true],
    ['by what grew beside it', at(100), { ...at(100), left: 40 }, true],
    ['by a few pixels', at(100), at(107), false],
    ['by scrolling', at(100), at(20, 80), false],
    ['while what it sticks to is scrolled', at(100), at(100, 80), false],
    ['by a banner while one scrolls', at(100), at(68, 80), true],
    ['by a page that scrolls as a banner comes', at(100), at(46, 54, 1_446), true],
    ['by a page that has less to scroll', at(100, 80), at(140, 40, 1_460), true],
  ])('%s', (_, before, now, moved) => {
    expect(wasMoved(before, now)).toBe(moved);
  });
});
