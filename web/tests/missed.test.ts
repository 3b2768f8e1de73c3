import { describe, expect, it } from 'vitest';
import { DECIDING_KEYS, DRIVING_KEYS } from '../src/lib/jog/bindings';
import { Keys } from '../src/lib/keys/keys';

const key = (name: string, more: object = {}) => ({ key: name, code: '', repeat: false, ctrlKey: false, metaKey: false, altKey: false, defaultPrevented: false, ...more });

describe('the keyboard', () => {
  it('tells of a shortcut that it takes for typed, and of no other key', () => {
    const [keys, missed] = [new Keys(), new Array<string>()];
    keys.onMissed((one) => missed.push(one));
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
    free();
    keys.single = false;
    expect(follow('p')).toEqual([]);
  });
});
