import { describe, expect, it, vi } from 'vitest';
import { DECIDING_KEYS, DRIVING_KEYS } from '../src/lib/jog/bindings';
import { Keys } from '../src/lib/keys/keys';

const key = (name: string, more: object = {}) => ({ key: name, code: '', repeat: false, ctrlKey: false, metaKey: false, altKey: false, defaultPrevented: false, ...more });

describe('the keyboard', () => {
  it('tells of a shortcut that it takes for typed, and of no other key', () => {
    const [keys, missed] = [new Keys(), new Array<string>()];
    keys.onMissed((one, by) => missed.push(`${by === 'typed' ? '' : by}${one}`));
    keys.on('p', 'pause', () => undefined, true);
    keys.on('a', 'approve', () => undefined);
    const follow = (...names: string[]): string[] => {
      keys.press(key('c'), true);
      for (const name of names) keys.press(key(name), false);
      return missed.splice(0);
    };
    keys.press(key('p'), false);
    expect([missed, follow('o', 'P', 'Backspace', 'a')]).toEqual([[], ['p', 'a']]);
    keys.press(key('p', { repeat: true }), false);
    const uncover = keys.cover();
    expect([missed, follow('a', 'p')]).toEqual([[], ['p']]);
    uncover();
    const free = keys.reserve(...DRIVING_KEYS, ...DECIDING_KEYS);
    expect(follow('a', 'p')).toEqual(['p']);
    keys.press(key('c'), true);
    keys.press(key('ArrowDown', { code: 'ArrowDown' }), false);
    expect(missed.splice(0)).toEqual(['ArrowDown']); // whoever drives is told why nothing moves
    free();
    keys.press(key('c'), true);
    keys.press(key('ArrowDown', { code: 'ArrowDown' }), false);
    expect(missed).toEqual([]);
    keys.single = false;
    expect(follow('p')).toEqual([]);
  });

  it('hears the pause on a keyboard that is switched to another script, and no answer', () => {
    const [keys, ran] = [new Keys(), new Array<string>()];
    for (const one of ['a', 'p']) keys.on(one, one, () => ran.push(one));
    const press = (letter: string, code: string, typing = false): boolean => keys.press(key(letter, { code }), typing);
    expect([press('з', 'KeyP'), press('З', 'KeyP'), press('ф', 'KeyA'), press('ø', 'KeyP'), ran.splice(0)]).toEqual([true, true, false, false, ['p', 'p']]);
    expect([keys.pressBeside(key('פ', { code: 'KeyP' }), ['p']), press('з', 'KeyP', true), ran]).toEqual([true, false, ['p']]);
  });

  it('tells of a shortcut that a list keeps, but of those that are heard there', () => {
    const [keys, told] = [new Keys(), new Array<string>()];
    keys.onMissed((one, by) => told.push(`${one} ${by}`));
    for (const one of ['a', 'p']) keys.on(one, one, () => told.push(one));
    for (const one of ['a', 'w', 'p']) expect(keys.pressBeside(key(one), ['p'])).toBe(true);
    keys.pressBeside(key('a', { repeat: true }), ['p']);
    expect(told).toEqual(['a list', 'p']);
  });

  it('takes what is held, or corrected again and again, where a field is gone for typing that goes on', () => {
    const [keys, ran, now] = [new Keys(), new Array<string>(), vi.spyOn(performance, 'now')];
    keys.on('a', 'approve', () => ran.push('a'));
    const press = (name: string, atMs: number, more = {}, typing = false): boolean => (now.mockReturnValue(atMs), keys.press(key(name, more), typing));
    const held = { repeat: true };
    for (const [name, more] of [['Backspace', held], ['Backspace', {}], ['ArrowLeft', held], ['x', held]] as const) {
      press(name, 0, {}, true);
      for (const ms of [500, 1_500, 2_500, 3_500]) expect([name, press(name, ms, more)]).toEqual([name, true]);
      expect([name, press('a', 5_000), ran]).toEqual([name, true, []]);
    }
    press('ArrowLeft', 10_000, {}, true);
    expect([press('ArrowLeft', 11_000), press('ArrowLeft', 12_100), press('a', 12_200), ran]).toEqual([true, false, true, ['a']]); // whoever goes on by it means it
    now.mockRestore();
  });
});
