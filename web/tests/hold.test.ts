import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import { gamepadAxes, plugged, standardPad, Sticks } from '../src/lib/jog/bindings';
import { JogKeys, pressesButton, type Key } from '../src/lib/jog/keyboard';
import { jogNames } from '../src/lib/jog/layout';
import { padWords } from '../src/lib/jog/words';
import { Keys, pressedBySpace, takesKeys } from '../src/lib/keys/keys';
import { HoldToRun, type Command, type Speeds } from '../src/lib/jog/hold';

const SPEEDS: Speeds = { base_x: 0.2, base_y: 0.2, base_yaw: 0.4, tool_x: 0.1, tool_y: 0.1, tool_z: 0.1 };
const STILL: Command = { base: [0, 0, 0], tool: [0, 0, 0], grip: null };

describe('hold to run', () => {
  let said: { at: number; command: Command }[];
  let hold: HoldToRun;

  beforeEach(() => {
    vi.useFakeTimers({ now: 0 });
    said = [];
    hold = new HoldToRun((command) => said.push({ at: Date.now(), command }), SPEEDS);
  });
  afterEach(() => vi.useRealTimers());

  it('speaks at once, then at least ten times a second while a key is held', () => {
    hold.hold('ArrowUp', 'base_x', 1);
    vi.advanceTimersByTime(1000);
    expect(said[0]).toEqual({ at: 0, command: { ...STILL, base: [0.2, 0, 0] } });
    const gaps = said.slice(1).map((word, k) => word.at - (said[k]?.at ?? 0));
    expect(said.length).toBeGreaterThanOrEqual(11);
    expect(Math.max(...gaps)).toBeLessThan(100);
  });

  it('says zero at once on release, and then nothing more', () => {
    hold.hold('ArrowUp', 'base_x', 1);
    vi.advanceTimersByTime(120);
    hold.release('ArrowUp');
    expect(said.at(-1)).toEqual({ at: 120, command: STILL });
    const count = said.length;
    vi.advanceTimersByTime(1000);
    expect([said.length, hold.running]).toEqual([count, false]);
  });

  it('goes on with what is still held', () => {
    hold.hold('ArrowUp', 'base_x', 1);
    hold.hold('KeyQ', 'base_yaw', 1);
    hold.release('ArrowUp');
    expect(said.at(-1)?.command.base).toEqual([0, 0, 0.4]);
    expect(hold.running).toBe(true);
  });

  it('lets two sources on one axis never exceed its speed, and opposite ones cancel', () => {
    hold.hold('ArrowUp', 'base_x', 1);
    hold.hold('pad', 'base_x', 1);
    expect(hold.command().base[0]).toBe(0.2);
    hold.hold('ArrowDown', 'base_x', -1);
    hold.release('pad');
    expect(hold.command().base[0]).toBe(0);
  });

  it('does not say that anything moves while opposite ways are held', () => {
    const words = (): string => padWords({ covered: false, ready: true, running: hold.running, moves: hold.moves, refused: null });
    hold.hold('ArrowUp', 'base_x', 1);
    expect(words()).toBe('Moving while you hold');
    hold.hold('ArrowDown', 'base_x', -1);
    expect(words()).toBe('Not moving: you hold opposite ways');
    hold.holdGrip('open');
    expect(words()).toBe('Moving while you hold');
    hold.releaseAll();
    expect(words()).toBe('Hold to run; let go to stop');
  });

  it('lets go of everything when the window is left', () => {
    hold.hold('ArrowUp', 'base_x', 1);
    hold.holdGrip('close');
    hold.releaseAll();
    expect(said.at(-1)?.command).toEqual(STILL);
    expect(hold.running).toBe(false);
  });

  it('says nothing when there is nothing to let go of', () => {
    hold.releaseAll();
    hold.release('ArrowUp');
    hold.hold('gamepad base_x', 'base_x', 0);
    expect(said).toEqual([]);
  });
});

describe('a gamepad', () => {
  it('rests inside its dead zone, and reaches full deflection', () => {
    const rest = gamepadAxes({ axes: [0.1, -0.1, 0.05, 0.17], buttons: [] });
    expect(Object.values(rest).every((value) => value === 0)).toBe(true);
    expect(gamepadAxes({ axes: [0, -1, 0, 0], buttons: [] }).base_x).toBeCloseTo(1);
  });

  it('holds nothing by what is no number, nor where the browser does not say what is held', () => {
    expect(gamepadAxes({ axes: [NaN, NaN], buttons: [] })).toMatchObject({ base_x: 0, base_y: 0 });
    const forbidden = { getGamepads: () => { throw new DOMException('no', 'SecurityError'); } };
    expect([plugged(forbidden), plugged({}), plugged({ getGamepads: () => [null] })]).toEqual([[], [], [null]]);
  });

  const pad = (y: number, index = 0, id = 'pad'): Parameters<Sticks['read']>[0] => ({ index, id, axes: [0, y, 0, 0], buttons: [] });

  it('counts once its sticks have been at rest, and says so until then', () => {
    const sticks = new Sticks();
    expect([sticks.read(pad(-1)), sticks.ignored]).toEqual([null, true]);
    expect([sticks.read(pad(0))?.base_x, sticks.ignored]).toEqual([0, false]);
    expect([sticks.read(pad(-1))?.base_x, sticks.ignored]).toEqual([1, false]);
  });

  it('rests anew when another takes its place, with a stick held or not', () => {
    for (const [index, id] of [[1, 'pad'], [0, 'other']] as const) {
      const sticks = new Sticks();
      sticks.read(pad(0));
      expect([sticks.read(pad(-1))?.base_x, sticks.read(pad(-1, index, id)), sticks.ignored]).toEqual([1, null, true]);
      expect([sticks.read(pad(0, index, id))?.base_x, sticks.read(pad(-1, index, id))?.base_x]).toEqual([0, 1]);
    }
  });

  it('drives only if its layout is the standard one, and is named where it is not', () => {
    const one = (mapping: string, id: string, connected = true, index = 0): { mapping: string; id: string; connected: boolean; index: number } => ({ mapping, id, connected, index });
    expect(standardPad([null, one('', 'wheel'), one('standard', 'pad')], null)).toEqual({ pad: one('standard', 'pad'), other: '' });
    expect(standardPad([one('standard', 'gone', false), one('', 'wheel')], 0)).toEqual({ pad: null, other: 'wheel' });
    expect(standardPad([], null)).toEqual({ pad: null, other: '' });
    const [first, second] = [one('standard', 'first'), one('standard', 'second', true, 1)];
    expect([null, 0, 1, 2].map((used) => standardPad([first, second], used).pad?.id)).toEqual(['first', 'first', 'second', 'first']);
  });

  it('starts nothing by itself after something let go of the robot, however long it is held', () => {
    const sticks = new Sticks();
    for (const away of [() => sticks.letGo(), () => void sticks.read(null)]) {
      sticks.read(pad(0));
      away();
      expect([sticks.read(pad(-1)), sticks.read(pad(-1)), sticks.ignored]).toEqual([null, null, true]);
    }
  });
});

describe('keys that drive', () => {
  let said: Command[];
  let hold: HoldToRun;
  let jogKeys: JogKeys;
  const key = (code: string, of: Partial<Key> = {}): Key => ({ key: code, code, repeat: false, ctrlKey: false, metaKey: false, altKey: false, ...of });

  beforeEach(() => {
    vi.useFakeTimers({ now: 0 });
    said = [];
    hold = new HoldToRun((command) => said.push(command), SPEEDS);
    jogKeys = new JogKeys(hold, () => hold.releaseAll());
  });
  afterEach(() => vi.useRealTimers());

  it.each(['Meta', 'OS', 'Control', 'Alt'])('let go of everything when %s comes, and start nothing until they are pressed anew', (name) => {
    jogKeys.take(key('ArrowUp'), true, false);
    jogKeys.take(key('BracketLeft'), true, false);
    jogKeys.take(key(name), true, false); // whose own flag is not up yet in every browser
    expect([said.at(-1), hold.running]).toEqual([STILL, false]);
    const count = said.length;
    jogKeys.take(key('ArrowUp', { repeat: true, metaKey: true }), true, false);
    jogKeys.take(key(name), false, false);
    jogKeys.take(key('ArrowUp', { repeat: true }), true, false);
    vi.advanceTimersByTime(1000);
    expect([said.length, hold.running]).toEqual([count, false]);
    jogKeys.take(key('ArrowUp'), true, false);
    expect(said.at(-1)?.base).toEqual([0.2, 0, 0]);
  });

  it.each(['metaKey', 'ctrlKey', 'altKey'] as const)('let go of everything when another key says %s, pressed or let go of', (flag) => {
    for (const down of [true, false]) {
      jogKeys.take(key('ArrowUp'), true, false);
      expect(jogKeys.take(key('KeyQ', { [flag]: true }), down, false)).toBe(false);
      expect([said.at(-1), hold.running]).toEqual([STILL, false]);
    }
  });

  it.each([{ tagName: 'INPUT', type: 'radio' }, { tagName: 'INPUT', type: 'range' }, { tagName: 'INPUT', type: 'checkbox' }, { tagName: 'SELECT' }, { tagName: 'OPTION' }, { tagName: 'SUMMARY' }, { tagName: 'TEXTAREA' }])('leave the arrows to $tagName $type', (focused) => {
    expect(jogKeys.take(key('ArrowDown'), true, takesKeys(focused))).toBe(false);
    expect([said, hold.running]).toEqual([[], false]);
  });

  it('drive while a button has the focus, or nothing', () => {
    expect([takesKeys({ tagName: 'BUTTON' }), takesKeys({ tagName: 'BODY' }), takesKeys(null)]).toEqual([false, false, false]);
  });

  it('press no button together with a modifier', () => {
    expect([pressesButton(key('Enter')), pressesButton(key('Enter', { metaKey: true })), pressesButton(key('Enter', { repeat: true }))]).toEqual([true, false, false]);
  });

  it('leave Space to what it presses, which a link is not', () => {
    const pressed = [{ tagName: 'BUTTON' }, { tagName: 'SUMMARY' }, { tagName: 'SELECT' }, { tagName: 'INPUT', type: 'radio' }];
    expect(pressed.map(pressedBySpace)).toEqual([true, true, true, true]);
    expect([{ tagName: 'A' }, { tagName: 'BODY' }, { tagName: 'INPUT', type: 'range' }, null].map(pressedBySpace)).toEqual([false, false, false, false]);
  });

  it('leave letters to what is typed in, and still stop there', () => {
    expect(jogKeys.take(key('KeyQ'), true, true)).toBe(false);
    expect(said).toEqual([]);
    jogKeys.take(key('KeyQ'), true, false);
    jogKeys.take(key('KeyQ'), false, true);
    expect(hold.running).toBe(false);
  });

  it('are for what lies over the page, for as long as it does', () => {
    const keys = new Keys();
    const uncover = keys.cover();
    expect([jogKeys.take(key('ArrowDown'), true, keys.covered), said.length]).toEqual([false, 0]);
    uncover();
    expect([jogKeys.take(key('ArrowDown'), true, keys.covered), hold.running]).toEqual([true, true]);
  });

  it('are called what is printed on them, and where the stop is, nothing', () => {
    const azerty = new Map([['KeyQ', 'a'], ['KeyE', 'e'], ['BracketLeft', '^'], ['BracketRight', '$']]);
    expect(jogNames(null)).toEqual({ turn: 'Q E', tool: 'I K J L', lift: 'U O', grip: '[ ]' });
    expect(jogNames(azerty)).toEqual({ turn: 'A E', tool: 'I K J L', lift: 'U O', grip: '^ $' });
    expect(jogNames(new Map([['KeyQ', "'"], ['KeyE', '.']])).turn).toBe("' –");
  });
});
