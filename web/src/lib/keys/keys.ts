import { createSubscriber } from 'svelte/reactivity';
import { entryOf } from '../format/entry';

/** The keyboard: one listener, shortcuts by key, and the stop that is heard everywhere. */
export interface Shortcut {
  key: string;
  /** What it does, for the list that `?` opens. */
  says: string;
  /** Returning false leaves the key to an older registration, and then to whatever has the focus. */
  run: () => unknown;
  /** Whether it counts while something lies over the page: what cannot be seen is not answered, but restrained. */
  everywhere: boolean;
}

/** Why a key was not heard: it came upon what was typed, or a list that has the focus keeps it. */
export type Missed = 'typed' | 'list';

interface KeyLike {
  key: string;
  /** Which key of the keyboard it is, whatever is printed on it. */
  code: string;
  repeat: boolean;
  ctrlKey: boolean;
  metaKey: boolean;
  altKey: boolean;
  defaultPrevented: boolean;
}

/** Whether keys typed into this element are text. */
export function isTyping(target: { tagName?: string; type?: string; isContentEditable?: boolean } | null): boolean {
  if (target === null) return false;
  if (target.isContentEditable === true) return true;
  if (target.tagName === 'TEXTAREA') return true;
  const buttons = ['button', 'checkbox', 'radio', 'range', 'submit', 'reset', 'file'];
  return target.tagName === 'INPUT' && !buttons.includes(target.type ?? 'text');
}

/** Whether letters typed into this element are its own: text, or the beginning of a choice in a list, where an open one has the focus. */
export function takesLetters(target: Parameters<typeof isTyping>[0]): boolean {
  return ['SELECT', 'OPTION'].includes(target?.tagName ?? '') || isTyping(target);
}

/** Whether the focused element does something of its own with keys, arrows among them; a button only with Enter and Space. */
export function takesKeys(target: Parameters<typeof isTyping>[0]): boolean {
  return takesLetters(target) || ['INPUT', 'SUMMARY'].includes(target?.tagName ?? '');
}

/** Whether arrows are its own: they turn the camera of the picture of a cell, and choose among verdicts. */
export function takesArrows(target: { tagName?: string; type?: string } | null): boolean {
  return target?.tagName === 'CANVAS' || (target?.tagName === 'INPUT' && target.type === 'radio');
}

/** Whether Space presses what has the focus; a link is followed by Enter alone. */
export function pressedBySpace(target: { tagName?: string; type?: string } | null): boolean {
  if (target?.tagName === 'INPUT') return target.type === 'checkbox' || target.type === 'radio';
  return ['BUTTON', 'SUMMARY', 'SELECT'].includes(target?.tagName ?? '');
}

/** Whether Escape takes back there what was begun, before it closes anything around it. */
export function takesEscape(target: Element | null): boolean {
  return target?.closest('[data-takes-escape]') != null;
}

/** What follows within so long upon what was typed, or upon its field being gone, is typed as well, unless one went elsewhere meanwhile. */
const GOES_ON_MS = 2_000;
/** These lead out of a field. */
const LEAVES: ReadonlySet<string> = new Set(['Tab', 'Escape']);
/** These correct what was typed, and are no signs: an input method that composes names no key but itself. */
const CORRECTS: ReadonlySet<string> = new Set(['Backspace', 'Delete', 'Dead', 'Compose', 'Process', 'Unidentified']);
/** These are pressed in the midst of typing, or of choosing in a list. */
const WITHIN: ReadonlySet<string> = new Set([...CORRECTS, 'Enter', 'ArrowLeft', 'ArrowRight', 'ArrowUp', 'ArrowDown', 'Home', 'End', 'PageUp', 'PageDown']);
/** These say nothing of where one is. */
const WITH_OTHERS: ReadonlySet<string> = new Set(['Shift', 'Control', 'Alt', 'AltGraph', 'Meta', 'CapsLock']);

/** Whoever scrolls by Space does so again within so long. */
const SCROLLS_MS = 1_000;

/** The key that stops, from anywhere. */
export const STOP_KEY = '.';
const LAST_LATIN = '\u024f';

/** Says whether a key press is the emergency stop: `.` anywhere, with Ctrl or Cmd while typing. */
export function isStop(event: KeyLike, typing: boolean): boolean {
  // An input method that is composing names no key, and another script than Latin has a letter where its keyboards show the sign as well.
  const there = event.code === 'Period' && (event.key === 'Process' || (event.key.length === 1 && event.key > LAST_LATIN));
  if (event.key !== STOP_KEY && !there) return false;
  return typing ? event.ctrlKey || event.metaKey : true;
}

/** Whether it is pressed without what makes it the browser's or the system's. */
function isBare({ ctrlKey, metaKey, altKey }: KeyLike): boolean {
  return !ctrlKey && !metaKey && !altKey;
}

/** Says whether a key press may be a shortcut at all. */
export function mayBeShortcut(event: KeyLike, letters: boolean): boolean {
  return !letters && !event.repeat && isBare(event) && !event.defaultPrevented;
}

/**
 * Says whether a key press would open a search of the browser's own, as these do in Firefox: it had every key from there
 * on, that of the stop, too.
 */
export function opensSearch(event: KeyLike, typing: boolean): boolean {
  return !typing && (event.key === '/' || event.key === "'") && isBare(event);
}

/** What restrains is heard by its place where the keyboard is switched to another script: where `P` lies, all that have Latin letters beside have it. */
const BESIDE: Readonly<Record<string, string>> = { KeyP: 'p' };

/** What a key is called among the shortcuts. */
function named({ key, code }: { key: string; code: string }): string {
  if (key.length !== 1) return key;
  return (key > LAST_LATIN ? entryOf(BESIDE, code) : undefined) ?? key.toLowerCase();
}

export class Keys {
  private readonly shortcuts: Shortcut[] = [];
  private stop: () => void = () => undefined;
  private missed: (key: string, by: Missed) => void = () => undefined;
  private covers = 0;
  private coverChanged: () => void = () => undefined;
  private readonly heedCovers = createSubscriber((changed) => {
    this.coverChanged = changed;
    return () => (this.coverChanged = () => undefined);
  });
  private reserved: readonly { kept: ReadonlySet<string>; untilMs: number; stillMs: number }[] = [];
  /** When one was last at what takes letters; NaN where one went elsewhere since, by a finger or a key. */
  private typedMs = NaN;
  private sign = '';
  /** The key that came down last, and on what. */
  private last: { code: string; on: HTMLElement | null; ms: number } | null = null;
  /** Whether single characters count at all (WCAG 2.1.4); the stop always does. */
  single = true;

  /** Whether a key is one of those that the person has switched off: letters, digits and signs. */
  ignores({ key }: { key: string }): boolean {
    return !this.single && key.length === 1 && key !== ' ';
  }

  /** Whether something lies over the page. */
  get covered(): boolean {
    this.heedCovers();
    return this.covers > 0;
  }

  /** Says that something lies over the page; returns how to take it back. */
  cover(): () => void {
    this.covers += 1;
    this.coverChanged();
    return () => {
      this.covers -= 1;
      this.coverChanged();
    };
  }

  /**
   * Keeps keys, by their place (`KeyboardEvent.code`) or by their letter, from being shortcuts, the stop excepted: what
   * turns a robot on one keyboard is the letter that approves on another. Returns how to take it back so long after the
   * last of those places was held or pressed: whoever loses a robot holds on, and presses once more.
   */
  reserve(...some: readonly string[]): (stillMs?: number) => void {
    const one = { kept: new Set(some), untilMs: Infinity, stillMs: 0 };
    this.reserved = [...this.reserved, one];
    return (stillMs = 0) => {
      one.stillMs = stillMs;
      one.untilMs = performance.now() + stillMs;
    };
  }

  /** Hears a key that may be a reserved one, pressed, held or let go; returns whether it is. */
  private keeps(event: KeyLike): boolean {
    const nowMs = performance.now();
    this.reserved = this.reserved.filter(({ untilMs }) => nowMs < untilMs);
    for (const one of this.reserved) if (one.untilMs < Infinity && one.kept.has(event.code)) one.untilMs = nowMs + one.stillMs;
    return this.reserved.some(({ kept }) => kept.has(event.code) || kept.has(named(event)));
  }

  /** The newest registration of a key that takes it counts; returns how to take it back. */
  on(key: string, says: string, run: () => unknown, everywhere = false): () => void {
    const shortcut = { key, says, run, everywhere };
    this.shortcuts.push(shortcut);
    return () => {
      const at = this.shortcuts.indexOf(shortcut);
      if (at !== -1) this.shortcuts.splice(at, 1);
    };
  }

  onStop(run: () => void): void {
    this.stop = run;
  }

  /** Tells of a shortcut, or of a key that drives, that was not heard, and why: whoever meant it presses it again. */
  onMissed(tell: (key: string, by: Missed) => void): void {
    this.missed = tell;
  }

  list(): Shortcut[] {
    return [...new Map(this.shortcuts.map((shortcut) => [shortcut.key, shortcut])).values()];
  }

  /** Returns true when the key was taken. `letters`: they are the focused element's own, although it is no text. */
  press(event: KeyLike, typing: boolean, letters = typing): boolean {
    if (isStop(event, typing)) {
      if (!event.repeat) this.stop();
      if (typing) this.typedMs = NaN; // whoever stops has done with typing
      return true;
    }
    const barred = this.keeps(event) || !mayBeShortcut(event, letters) || this.ignores(event);
    const meant = barred ? [] : this.meantBy(event);
    if (!this.typed(event, letters)) return meant.findLast((known) => known.run() !== false) !== undefined;
    this.miss(event, meant.length > 0);
    return true;
  }

  /** Tells of a key that was meant for a shortcut, or to drive: those that do are reserved by their place. */
  private miss(event: KeyLike, meant: boolean): void {
    const drives = this.reserved.some(({ kept, untilMs }) => untilMs === Infinity && kept.has(event.code));
    if (meant || (drives && !event.repeat && !this.ignores(event))) this.missed(named(event), 'typed');
  }

  /** The registrations of a key that count now. */
  private meantBy(event: KeyLike): Shortcut[] {
    const wanted = named(event);
    return this.shortcuts.filter((known) => known.key === wanted && (!this.covered || known.everywhere));
  }

  /** Whether it is typed into a field, or a list, that the page took away: then it is no shortcut, and presses nothing. */
  private typed(event: KeyLike, letters: boolean): boolean {
    const { key } = event;
    if (WITH_OTHERS.has(key)) return false;
    const nowMs = performance.now();
    const goesOn = nowMs - this.typedMs < GOES_ON_MS && (key.length === 1 || WITHIN.has(key));
    if (letters) this.typedMs = LEAVES.has(key) ? NaN : nowMs;
    else if (!goesOn) this.typedMs = NaN;
    else if (this.isMore(event)) this.typedMs = nowMs;
    this.sign = key;
    return goesOn && !letters && isBare(event);
  }

  /** Whether more is typed by it: no word goes on by one sign, and whoever presses a shortcut again and again is heard. */
  private isMore({ key, repeat }: KeyLike): boolean {
    return repeat || key !== this.sign || CORRECTS.has(key);
  }

  /** Whether what has the focus by now is not what Space or Enter was meant to press. */
  private strays(event: KeyLike, on: HTMLElement | null): boolean {
    const so = (event.key === ' ' || event.key === 'Enter') && !takesLetters(on) && this.cameFrom(event, on);
    this.last = { code: event.code, on: so ? (this.last?.on ?? null) : on, ms: performance.now() };
    return so;
  }

  /** Whether a key came down on something else than this, and is held; or was pressed a moment ago where it scrolls. */
  private cameFrom({ code, repeat }: KeyLike, on: HTMLElement | null): boolean {
    const { last } = this;
    if (last === null || last.on === on) return last === null && repeat;
    if (repeat) return true;
    return last.code === code && !pressedBySpace(last.on) && last.on?.tagName !== 'A' && performance.now() - last.ms < SCROLLS_MS;
  }

  private pointed(at: HTMLElement | null): void {
    this.typedMs = takesLetters(at) ? performance.now() : NaN;
    this.last = null;
  }

  /** What takes letters has got the focus, or has lost it: by a finger, or by a key that leads out of it, or else by the page. */
  private attend(event: FocusEvent): void {
    if (!takesLetters(event.target as HTMLElement | null)) return;
    if (event.type === 'focusin' || !Number.isNaN(this.typedMs)) this.typedMs = performance.now();
  }

  /**
   * Takes a key pressed in a list of choices that stands beside an answer, or of cells: its letters choose nothing, since
   * whoever presses one means the answer, or what is to be done to a cell. Only `restraining` shortcuts are heard there. Returns true when the key was taken.
   */
  pressBeside(event: KeyLike, restraining: readonly string[]): boolean {
    if (this.ignores(event) || event.key.length !== 1 || event.key === ' ' || !isBare(event)) return false;
    this.typedMs = NaN; // it was no choice
    if (restraining.includes(named(event))) this.press(event, false);
    else if (!event.repeat && this.meantBy(event).length > 0) this.missed(named(event), 'list');
    return true;
  }

  /** Listens before anything else on the page does. */
  attach(target: Window): () => void {
    const listen = (event: KeyboardEvent): void => {
      const target = event.target as HTMLElement | null;
      const typing = isTyping(target);
      if (this.strays(event, target) || this.press(event, typing, takesLetters(target))) {
        event.preventDefault();
        event.stopPropagation();
      } else if (opensSearch(event, typing)) event.preventDefault();
    };
    const end = new AbortController();
    const how = { capture: true, signal: end.signal };
    target.addEventListener('pointerdown', (event) => this.pointed(event.target as HTMLElement | null), how);
    target.addEventListener('keydown', listen, how);
    target.addEventListener('keyup', (event) => this.keeps(event), how);
    for (const change of ['focusin', 'focusout'] as const) target.addEventListener(change, (event) => this.attend(event), how);
    return () => end.abort();
  }
}

export const keys = new Keys();
