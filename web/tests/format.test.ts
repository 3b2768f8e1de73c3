import { describe, expect, it, vi } from 'vitest';
import { heldIn, loadOf, titleOf } from '../src/lib/format/capability';
import { entriesOf, eventLine } from '../src/lib/format/events';
import { figuresOf, labelOf, unitOf, valueOf } from '../src/lib/format/quantity';
import type { Cell, Control } from '../src/lib/api/documents';
import { pausedWords } from '../src/lib/live/control';
import { robotSays, whoWords } from '../src/lib/format/status';
import { quoted, sentence } from '../src/lib/format/quoted';
import { clockTime, countdown, dayOf, elapsed, fullTime, left, timeSeenOn } from '../src/lib/format/time';
import { DECIDING_KEYS, DRIVING_KEYS } from '../src/lib/jog/bindings';
import { isStop, isTyping, Keys, takesLetters } from '../src/lib/keys/keys';
import { dashes } from '../src/lib/scene/overlay';
import { hatch } from '../src/lib/scene/ground';
import { fromSnapshot, merged, NOTHING } from '../src/lib/state/documents';
import { cell, escalation, event, heldBy, scene } from './samples';

const key = (name: string, more: object = {}) => ({ key: name, code: '', repeat: false, ctrlKey: false, metaKey: false, altKey: false, defaultPrevented: false, ...more });

describe('who sits here', () => {
  it('is a name and a role, and the cell they stand at', () => {
    expect(whoWords({ name: 'ann', role: 'operator', station: null })).toBe('ann, operator');
    expect(whoWords({ name: 'bob', role: 'operator', station: 'workcell-1' })).toBe('bob, operator at workcell-1');
  });
});

describe('times', () => {
  it('count down to zero and not below it', () => {
    expect([countdown(84_000), countdown(83_001), countdown(0), countdown(-5_000), countdown(3_725_000)]).toEqual(['1:24', '1:24', '0:00', '0:00', '1:02:05']);
  });

  it('count up in whole seconds that are over', () => {
    expect([elapsed(46_900), elapsed(-3)]).toEqual(['0:46', '0:00']);
  });

  it('of another day are told with that day', () => {
    const [noon, night, other] = [new Date(2026, 10, 22, 12), new Date(2026, 10, 22, 23, 59, 59), new Date(2026, 10, 23)].map(Number);
    expect(timeSeenOn(dayOf(night ?? 0), noon ?? 0)).toBe(clockTime(noon ?? 0));
    expect(timeSeenOn(dayOf(other ?? 0), night ?? 0)).toBe(fullTime(night ?? 0));
    expect(timeSeenOn(dayOf(noon ?? 0), 'never')).toBe('–');
  });

  it('are said in minutes or seconds', () => {
    expect([left(660_000), left(40_000)]).toEqual(['11 min left', '40 s left']);
    expect([left(899_000), left(120_000), left(90_000)]).toEqual(['14 min left', '2 min left', '90 s left']); // never more than there is
  });
});

describe('quantities', () => {
  it('have the unit and the digits of their name', () => {
    expect([unitOf('speed_mps'), unitOf('force_n'), unitOf('residual_nm'), unitOf('object_id')]).toEqual(['m/s', 'N', 'N·m', '']);
    expect([valueOf('speed_mps', 0.5), valueOf('force_n', 17.62), valueOf('force_n', 60), valueOf('x', null)]).toEqual(['0.50', '17.62', '60', '–']);
    expect([valueOf('speed_mps', 0.125), valueOf('force_n', 100.4), valueOf('yaw_rad', Math.PI / 2), valueOf('force_n', NaN)]).toEqual(['0.125', '100.4', '1.5708', '–']);
    expect(figuresOf({ speed_mps: 0.1, object_id: 'mug_1', force_n: 40 })).toBe('40 N, 0.10 m/s');
    expect([labelOf('force_n'), labelOf('travel_time_s')]).toEqual(['Grip force', 'Travel time']);
  });
});

describe('the server’s words', () => {
  it('have names in quotes, and are a sentence', () => {
    expect(quoted('`inv_01ABCDEFGHJKMNPQRSTVWX` runs; valid: take that over')).toBe('“inv_…STVWX” runs. What works: take that over'.replace('…S', '…RS'));
    expect([quoted('a `b` c'), sentence('the bytes of `25` differ'), sentence('Done.')]).toEqual(['a “b” c', 'The bytes of “25” differ.', 'Done.']);
  });
});

describe('words', () => {
  it('say what a proposal would do', () => {
    expect(titleOf('transport_object', { target: 'bench_b_stand' }, 'glass_1')).toBe('Carry glass_1 to bench_b');
    expect(titleOf('polish_lens', {})).toBe('Polish lens');
    expect(titleOf('polish_lens', { with: 'cloth', lens: 'lens_2', force_n: 3, dry: true })).toBe('Polish lens: lens_2, cloth');
    expect(titleOf('polish_lens', { lens: 'x'.repeat(500) }).length).toBeLessThan(180);
  });

  it('tell events', () => {
    expect(eventLine(event('alert', { rule: 'separation', signal: 'VIOLATION', value: 0.972, threshold: 1.021 })).text).toBe('Separation 0.97 m, limit 1.02 m');
    expect(eventLine(event('alert', { rule: 'people', signal: 'VIOLATION', value: 0.972, threshold: 1 })).text).toBe('Separation 0.97 m, limit 1.00 m');
    expect(eventLine(event('alert', { rule: 'zone', signal: 'VIOLATION', value: -0.0021, threshold: 0 })).text).toBe('Zone margin -0.002 m, limit 0.000 m');
    expect(eventLine(event('alert', { rule: 'zone', signal: 'VIOLATION', value: -0.00001, threshold: 0 })).text).toBe('Zone margin 0.0000 m, limit 0.0000 m');
    expect(eventLine(event('alert', { rule: 'zone', signal: 'VIOLATION', value: -0.00001 })).text).toBe('Zone margin 0.00 m');
    expect(eventLine(event('alert', { rule: 'contact-force', signal: 'WARNING', value: 61.2, threshold: 60 })).text).toBe('Contact force 61.20 N, limit 60.00 N');
    expect(eventLine(event('outcome', { outcome: 'stopped', failure: 'object_lost' }))).toMatchObject({ tone: 'danger', strong: 'Stopped', text: ', object lost' });
    expect(eventLine(event('policy_version', { op: 'refuted', policy_version: 'sha256:0123456789' }))).toMatchObject({ tone: 'danger', text: 'Policy 0123456: its proofs are refuted' });
    expect(eventLine(event('policy_version', { op: 'awaiting_second', policy_version: 'sha256:0123456789' }))).toMatchObject({ tone: 'plain', text: 'Policy 0123456: waits for a second engineer' });
    expect(eventLine(event('something_new', {})).text).toBe('Something new');
  });

  it('put the gravest thing a robot says first', () => {
    expect(robotSays(cell({ latched: true, status: 'running' })).text).toBe('Stopped, latched');
    expect(robotSays(cell({ online: false, status: 'running' })).text).toBe('Not heard');
    expect(robotSays(cell({ online: false, latched: true })).text).toBe('Not heard, stop sent');
    expect(robotSays(cell({ fault: 'no room for the journal', status: null, busy: null })).text).toBe('Launches nothing');
    expect(robotSays(cell({ fault: 'no room for the journal', status: 'running', busy: 'inv_1' })).text).toBe('Running');
    expect(robotSays(cell({ status: 'paused' }))).toEqual({ text: 'Paused, holding', tone: 'danger' });
    expect(robotSays(cell({ status: 'paused', session: heldBy('operator') })).tone).toBe('warn'); // a person's own pause is no alarm
    expect(robotSays(cell({ status: 'paused', session: heldBy('operator', 'watch') })).tone).toBe('danger');
  });

  it('say that whoever drives moves nothing while the session is held', () => {
    const control: Control = { lease: 'lea_1', holder: 'ada', where: 'local', since: '2026-11-22T10:00:00.000Z', invocation: 'inv_1' };
    const said = ['running', 'paused', 'escalated'].map((status) => robotSays(cell({ status, control })).text);
    expect(said).toEqual(['Driven by hand', 'Driven by hand, paused', 'By hand, asks a person']);
    const held = (paused_by: string[], violated: string[] = []): Cell => cell({ status: 'paused', control, session: { phase: null, doing: 'takeover', violated, paused_by, waits_for: null } });
    expect(pausedWords(cell({ control }))).toBe(null);
    expect(pausedWords(held(['operator', 'watch'], ['separation']))).toEqual({ why: 'somebody paused the session', resumable: true });
    expect(pausedWords(held(['watch'], ['human-shared/separation', 'zone']))).toEqual({ why: 'a person is too near, a forbidden zone is too near', resumable: false });
    expect(pausedWords(held(['watch']))?.why).toBe('the watcher stopped it');
  });
});

/** Has keys listen to a window; returns how to have it tell something, which says whether that was taken. */
function ears(keys: Keys): (type: string, event: object) => boolean {
  const heard = new Map<string, (event: object) => void>();
  keys.attach({ addEventListener: (type: string, listen: (event: object) => void) => heard.set(type, listen) } as unknown as Window);
  return (type, told) => {
    const event = { type, ...told, preventDefault: vi.fn(), stopPropagation: vi.fn() };
    heard.get(type)?.(event);
    return event.preventDefault.mock.calls.length > 0;
  };
}

describe('the keyboard', () => {
  it('stops with a full stop from anywhere, and while typing with Ctrl or Cmd', () => {
    expect([isStop(key('.'), false), isStop(key('.'), true), isStop(key('.', { ctrlKey: true }), true), isStop(key('.', { metaKey: true }), true)]).toEqual([true, false, true, true]);
    const composing = { code: 'Period', ctrlKey: true };
    expect([isStop(key('Process', composing), true), isStop(key('Process', { ...composing, ctrlKey: false }), true)]).toEqual([true, false]);
    expect(isStop(key('Process', { ...composing, code: 'Comma' }), true)).toBe(false);
    // On a keyboard that is switched to another script, the full stop is printed beside a letter of it; one of Latin has it elsewhere.
    for (const letter of ['ю', 'Ю', 'ץ', 'ز', '。']) expect([letter, isStop(key(letter, { code: 'Period' }), false), isStop(key(letter, { code: 'Period' }), true), isStop(key(letter, composing), true)]).toEqual([letter, true, false, true]);
    expect([isStop(key('ç', { code: 'Period' }), false), isStop(key('v', { code: 'Period' }), false), isStop(key('ю', { code: 'Comma' }), false), isStop(key('Dead', { code: 'Period' }), false)]).toEqual([false, false, false, false]);
  });

  it('leaves none to a search that a browser opens by one, and that would have the next, the stop among them', () => {
    const keys = new Keys();
    const hear = ears(keys);
    const left = (name: string, tagName = 'BODY', more = {}): boolean => !hear('keydown', { ...key(name, more), target: { tagName } });
    expect([left('/'), left("'"), left('/', 'BUTTON')]).toEqual([false, false, false]); // Firefox opens its quick find
    expect([left('/', 'INPUT'), left("'", 'TEXTAREA'), left('/', 'BODY', { ctrlKey: true }), left('F2')]).toEqual([true, true, true, true]);
  });

  it('runs no shortcut while typing, with a modifier, or for a key that repeats', () => {
    const keys = new Keys();
    const ran: string[] = [];
    keys.on('a', 'approve', () => ran.push('a'));
    expect([keys.press(key('a'), true), keys.press(key('Tab'), true)]).toEqual([false, false]);
    expect([keys.press(key('a', { ctrlKey: true }), false), keys.press(key('a', { repeat: true }), false)]).toEqual([false, false]);
    expect([keys.press(key('A'), false), ran]).toEqual([true, ['a']]);
  });

  it('runs no shortcut, and presses nothing, by what one goes on to type into a field that is gone; the stop it runs', () => {
    const [keys, ran, now] = [new Keys(), new Array<string>(), vi.spyOn(performance, 'now')];
    for (const one of ['a', ' ']) keys.on(one, 'approve', () => ran.push(one));
    keys.onStop(() => ran.push('.'));
    const press = (name: string, atMs: number, typing = false): boolean => (now.mockReturnValue(atMs), keys.press(key(name), typing));
    expect([press('c', 0, true), press('a', 300), press(' ', 2_000), press('Shift', 3_000), press('A', 3_500), ran]).toEqual([false, true, true, false, true, []]);
    expect([press('.', 3_600), ran]).toEqual([true, ['.']]);
    expect([press('a', 5_600), ran]).toEqual([true, ['.', 'a']]);
    expect([press('c', 5_700, true), press('d', 5_800), press('a', 5_900), press('a', 6_800), press('a', 7_800), press('a', 8_000), ran.splice(0)]).toEqual([false, true, true, true, true, true, ['.', 'a', 'a']]);
    expect([press('c', 8_100, true), press('Escape', 8_200), press('a', 8_300), ran]).toEqual([false, false, true, ['a']]);
    now.mockRestore();
  });

  it('knows what is typed by more than its signs: a correction, an input method, a line break, a letter that chooses in a list', () => {
    const [keys, ran] = [new Keys(), new Array<string>()];
    for (const one of ['a', 'd', 'ArrowDown', 'F2']) keys.on(one, one, () => ran.push(one));
    const press = (name: string, more = {}): boolean => keys.press(key(name, more), false);
    for (const last of ['Backspace', 'Delete', 'ArrowLeft', 'Enter', 'Dead', 'Compose', 'Process', 'Unidentified', 'AltGraph', 'CapsLock', 'Control']) {
      keys.press(key('c'), true);
      expect([keys.press(key(last), true), press('a'), press('Backspace'), press('CapsLock'), press('a'), ran]).toEqual([false, true, true, false, true, []]);
      // What is held goes on, and presses nothing that has the focus by now; with a modifier it is the browser's.
      expect([press('a', { repeat: true }), press(' ', { repeat: true }), press('Enter'), press('Enter', { ctrlKey: true })]).toEqual([true, true, true, false]);
      // Nor does who goes through a text or a list that is gone scroll, drive or answer by it.
      for (const through of ['ArrowLeft', 'ArrowDown', 'End', 'PageUp']) expect([through, press(through), press('a'), ran]).toEqual([through, true, true, []]);
      expect([press('ArrowLeft', { ctrlKey: true }), press('a'), ran]).toEqual([false, true, []]);
      expect([press('F2'), press('a'), ran.splice(0)]).toEqual([true, true, ['F2', 'a']]);
    }
    expect([keys.press(key('w'), false, true), press('a'), ran]).toEqual([false, true, []]);
    expect([keys.pressBeside(key('x'), ['d']), keys.pressBeside(key('d'), ['d']), press('a'), ran]).toEqual([true, true, true, ['d', 'a']]);
  });

  it('keeps a key that drove from answering until it has been let go for a while, however long it was held', () => {
    const [keys, ran, now] = [new Keys(), new Array<string>(), vi.spyOn(performance, 'now')];
    keys.on('a', 'approve', () => ran.push('a'));
    const hear = ears(keys);
    const at = (ms: number, type: string, more = {}): boolean => (now.mockReturnValue(ms), hear(type, { ...key('a', { code: 'KeyQ' }), target: { tagName: 'BODY' }, ...more }));
    const free = keys.reserve(...DRIVING_KEYS, ...DECIDING_KEYS);
    at(0, 'keydown');
    free(1_000);
    for (const ms of [900, 1_800, 2_700]) at(ms, 'keydown', { repeat: true });
    at(3_600, 'keyup');
    at(4_500, 'keydown');
    at(4_600, 'keyup');
    expect(ran).toEqual([]);
    at(5_500, 'keydown', { code: 'KeyA' }); // another key is not what drove, and puts nothing off
    at(5_650, 'keydown');
    expect(ran).toEqual(['a']);
    now.mockRestore();
  });

  it('lets Space and Enter press nothing that got the focus while they were held, or while one scrolled', () => {
    const [keys, now] = [new Keys(), vi.spyOn(performance, 'now')];
    const hear = ears(keys);
    const [page, button, other, field] = ['MAIN', 'BUTTON', 'BUTTON', 'TEXTAREA'].map((tagName) => ({ tagName }));
    const at = (ms: number, target: object | undefined, name = ' ', more = {}): boolean => (now.mockReturnValue(ms), hear('keydown', { ...key(name, { code: name, ...more }), target }));
    const held = { repeat: true };
    expect([at(0, page), at(500, page, ' ', held), at(550, button, ' ', held), at(600, button, ' ', held), at(900, button), at(2_000, button)]).toEqual([false, false, true, true, true, false]);
    expect([at(2_100, button, 'Enter'), at(2_200, button, 'Enter', held), at(2_300, other, 'Enter', held), at(2_400, other, 'Enter')]).toEqual([false, false, true, false]);
    for (const between of [() => at(3_100, page, 'Tab'), () => hear('pointerdown', { target: page })]) {
      at(3_000, page);
      between();
      expect(at(3_200, button)).toBe(false);
    }
    expect([at(4_000, page), at(4_100, field), at(4_200, field, ' ', held)]).toEqual([false, false, false]);
    now.mockRestore();
  });

  it('counts from when the page took a field away, however long before that the last sign was typed', () => {
    const [keys, ran, now] = [new Keys(), new Array<string>(), vi.spyOn(performance, 'now')];
    keys.on('a', 'approve', () => ran.push('a'));
    const hear = ears(keys);
    const [field, button] = [{ tagName: 'TEXTAREA' }, { tagName: 'BUTTON' }];
    const at = (ms: number, type: string, target: object, name = ''): boolean => (now.mockReturnValue(ms), hear(type, { ...key(name), target }));
    const leaves = { Tab: () => at(9_000, 'keydown', field, 'Tab'), finger: () => at(9_000, 'pointerdown', button), page: () => at(9_000, 'pointerdown', field) };
    for (const [by, leave] of Object.entries(leaves)) {
      at(1_000, 'pointerdown', field);
      at(1_000, 'focusin', field);
      leave();
      at(30_000, 'focusout', field);
      at(31_900, 'keydown', button, 'a');
      expect([by, ran.splice(0)]).toEqual([by, by === 'page' ? [] : ['a']]);
    }
    at(38_000, 'focusin', field);
    hear('keydown', { ...key('.', { ctrlKey: true }), target: field });
    at(38_100, 'focusout', field);
    at(38_200, 'keydown', button, 'a');
    expect(ran.splice(0)).toEqual(['a']); // who stops has done with typing
    at(40_000, 'focusout', button);
    at(41_000, 'keydown', button, 'a');
    expect(ran).toEqual(['a']);
    now.mockRestore();
  });

  it('stops once for a key that is held, and swallows the rest', () => {
    const keys = new Keys();
    let stops = 0;
    keys.onStop(() => (stops += 1));
    expect([keys.press(key('.'), false), keys.press(key('.', { repeat: true }), false), stops]).toEqual([true, true, 1]);
  });

  it('stops from a list of choices, whose letters are its own', () => {
    const keys = new Keys();
    const ran: string[] = [];
    keys.onStop(() => ran.push('.'));
    keys.on('a', 'approve', () => ran.push('a'));
    const list = { tagName: 'SELECT' };
    expect(['OPTION', 'SELECT'].map((tagName) => takesLetters({ tagName }))).toEqual([true, true]); // which has the focus while it is open
    expect([isTyping(list), takesLetters(list), takesLetters({ tagName: 'BUTTON' })]).toEqual([false, true, false]);
    expect([keys.press(key('a'), isTyping(list), takesLetters(list)), keys.press(key('.'), isTyping(list), takesLetters(list)), ran]).toEqual([false, true, ['.']]);
  });

  it('stops from what chooses files, into which nobody types', () => {
    const chooser = { tagName: 'INPUT', type: 'file' };
    expect([isTyping(chooser), takesLetters(chooser)]).toEqual([false, false]);
  });

  it('hears in a list beside an answer only what restrains, and has no letter choose there', () => {
    const keys = new Keys();
    const ran: string[] = [];
    for (const one of ['a', 'd']) keys.on(one, one, () => ran.push(one));
    const taken = (name: string, more = {}): boolean => keys.pressBeside(key(name, more), ['d']);
    expect([taken('a'), taken('x'), taken('D'), taken('d', { repeat: true }), ran]).toEqual([true, true, true, true, ['d']]);
    expect([taken(' '), taken('ArrowDown'), taken('Enter'), taken('a', { ctrlKey: true })]).toEqual([false, false, false, false]);
  });

  it.each([['AZERTY', 'a', 'KeyQ'], ['Dvorak', 'r', 'KeyO'], ['Colemak', 'n', 'KeyJ']])('decides nothing on %s with a key that drives, and stops with any', (_, letter, code) => {
    const keys = new Keys();
    const ran: string[] = [];
    keys.onStop(() => ran.push('.'));
    keys.on(letter, letter, () => ran.push(letter));
    const free = keys.reserve(...DRIVING_KEYS);
    expect([keys.press(key(letter, { code }), false), keys.press(key(letter, { code: 'KeyZ' }), false)]).toEqual([false, true]);
    expect([keys.pressBeside(key(letter, { code }), [letter]), keys.press(key('.', { code: 'KeyE' }), false), ran]).toEqual([true, true, [letter, '.']]);
    free();
    expect([keys.press(key(letter, { code }), false), ran]).toEqual([true, [letter, '.', letter]]);
  });

  it('decides nothing by the letters beside the keys that drive while these drive, wherever they lie', () => {
    const keys = new Keys();
    const ran: string[] = [];
    for (const one of ['a', 'd', 's', 'p']) keys.on(one, one, () => ran.push(one));
    const free = keys.reserve(...DRIVING_KEYS, ...DECIDING_KEYS);
    for (const one of ['a', 'D', 's', 'p']) keys.press(key(one, { code: 'KeyZ' }), false);
    expect([ran, keys.pressBeside(key('d'), ['d'])]).toEqual([['p'], true]);
    free();
    expect([keys.press(key('d'), false), ran]).toEqual([true, ['p', 'd']]);
  });

  it('hears no single character once they are switched off, but the stop, and what is no character', () => {
    const keys = new Keys();
    const ran: string[] = [];
    keys.onStop(() => ran.push('.'));
    for (const one of ['a', '2', '?', ' ', 'Escape']) keys.on(one, one, () => ran.push(one), true);
    keys.single = false;
    for (const one of ['a', '2', '?', ' ', 'Escape', '.']) keys.press(key(one), false);
    expect([ran, keys.pressBeside(key('a'), ['a'])]).toEqual([[' ', 'Escape', '.'], false]);
    keys.single = true;
    expect(keys.press(key('a'), false)).toBe(true);
  });

  it('forgets a shortcut whose part of the page is gone', () => {
    const keys = new Keys();
    const undo = keys.on('a', 'one', () => undefined);
    undo();
    expect([keys.press(key('a'), false), keys.list()]).toEqual([false, []]);
  });
});

describe('what the server said', () => {
  const changes = { seq: 2, cells: [cell()], invocations: [], escalations: [escalation()], grants: [], reviews: [], events: [event('boot', {})] };

  it('keeps pending questions only', () => {
    const before = merged(NOTHING, changes);
    expect(Object.keys(merged(before, { seq: 3, escalations: [escalation({ status: 'denied' })] }).escalations)).toEqual([]);
  });

  it('takes an event once, and joins a snapshot that goes on where it was', () => {
    const before = merged(NOTHING, changes);
    const last = before.events[0];
    if (last === undefined) throw new Error('the sample has an event');
    const next = { ...last, seq: last.seq + 1 };
    expect(merged(before, { seq: 3, events: [last, next] }).events).toEqual([last, next]);
    expect(fromSnapshot({ ...changes, seq: next.seq, events: [next] }, before).events).toEqual([last, next]);
  });

  it('does not hide a gap: a snapshot that does not join begins anew', () => {
    const before = merged(NOTHING, changes);
    const far = { ...event('boot', {}), seq: 9_000 };
    expect(fromSnapshot({ ...changes, seq: 9_000, events: [far] }, before).events).toEqual([far]);
  });
});

describe('the scene', () => {
  it('cuts a path into dashes that go round its corners and never leave it', () => {
    const cut = dashes([[0, 0], [1, 0], [1, 1]], 0.2, 0.1);
    const length = cut.reduce((sum, [[ax, ay], [bx, by]]) => sum + Math.hypot(bx - ax, by - ay), 0);
    expect(length).toBeCloseTo(1.4, 5); // 2 m of path, two thirds of each 0.3 m drawn, and the last 0.2 m
    expect(cut.flat().every(([x, y]) => y === 0 || x === 1)).toBe(true);
  });

  it('hatches a zone within its edges', () => {
    const zone = scene.zones[0];
    const points = hatch(zone?.polygon ?? []);
    expect(points.length).toBeGreaterThan(60);
    for (let k = 0; k < points.length; k += 3) {
      expect(points[k]).toBeGreaterThanOrEqual(4.6 - 1e-9);
      expect(points[k]).toBeLessThanOrEqual(6.2 + 1e-9);
    }
  });
});

describe('the event log', () => {
  const jog = (seq: number) => ({ ...event('human', { op: 'jog', cell: 'workcell-1' }), seq });

  it('says once, with how often, what is said in a row', () => {
    const entries = entriesOf([jog(1), { ...event('boot', {}), seq: 2 }, jog(3), jog(4)], 10);
    expect(entries.map(({ event: { seq }, times }) => [seq, times])).toEqual([[4, 2], [2, 1], [1, 1]]);
  });

  it('ends with the oldest line there is room for, however often that was said', () => {
    const entries = entriesOf([{ ...event('boot', {}), seq: 1 }, jog(2), jog(3), jog(4)], 1);
    expect(entries.map(({ event: { seq }, times }) => [seq, times])).toEqual([[4, 3]]);
  });

  it('names other sessions shortly', () => {
    const reason = { rule: 'admission', code: 'cell_busy', message: '`workcell-1` is running `inv_01M813JGSNWGV9EG9QVKWK9RZN`', remedy: '' };
    expect(eventLine(event('admission', { outcome: 'defer', reasons: [reason] })).text).toContain('inv_…WK9RZN');
  });
});

describe('what a question is about', () => {
  it('is held by the cell it is asked in, not by the one that is looked at', () => {
    const facts = (holding: string) => ({ holding });
    const cells = { a: cell({ id: 'a', facts: facts('mug_1') }), b: cell({ id: 'b', facts: facts('box_1') }) };
    expect(heldIn(cells, 'b')).toBe('box_1');
    expect(heldIn(cells, 'gone')).toBeNull();
    expect(heldIn(cells, null)).toBeNull();
    expect(loadOf({ carried: null, cell: 'b' }, cells)).toBe('box_1');
  });

  it('is what was asked about, whatever has come into the gripper since', () => {
    expect(loadOf({ carried: 'mug_1', cell: 'b' }, { b: cell({ id: 'b', facts: { holding: 'glass_1' } }) })).toBe('mug_1');
  });
});
