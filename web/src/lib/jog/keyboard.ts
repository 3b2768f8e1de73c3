import { GRIP_KEYS, JOG_KEYS } from './bindings';
import type { HoldToRun } from './hold';

/** What is read of a `KeyboardEvent`. */
export interface Key {
  key: string;
  code: string;
  repeat: boolean;
  ctrlKey: boolean;
  metaKey: boolean;
  altKey: boolean;
}

const MODIFIERS: ReadonlySet<string> = new Set(['Meta', 'OS', 'Control', 'Alt']);

/** Whether a key, pressed or let go of, is the system's or the browser's; Shift alone changes nothing. */
export function meansOtherwise(event: Key): boolean {
  return MODIFIERS.has(event.key) || event.ctrlKey || event.metaKey || event.altKey;
}

/** Whether a key presses the button that has the focus; one that is still held presses it once. */
export function pressesButton(event: Key): boolean {
  return (event.key === ' ' || event.key === 'Enter') && !event.repeat && !meansOtherwise(event);
}

/**
 * Drives by keys.
 *
 * Whatever comes with a modifier lets go of everything: while Cmd is down, macOS says of no key that it was let go. What
 * is still held then only repeats, and a repeat starts nothing.
 */
export class JogKeys {
  constructor(
    private readonly hold: HoldToRun,
    private readonly letGo: () => void,
  ) {}

  /** Takes a key; returns whether it is one that drives. `kept`: keys are the focused element's own, or for what lies over the page. */
  take(event: Key, down: boolean, kept: boolean): boolean {
    if (meansOtherwise(event)) {
      this.letGo();
      return false;
    }
    if (down && kept) return false;
    if (!(event.code in JOG_KEYS) && !(event.code in GRIP_KEYS)) return false;
    if (!event.repeat) this.say(event.code, down);
    return true;
  }

  private say(code: string, down: boolean): void {
    const [axis, grip] = [JOG_KEYS[code], GRIP_KEYS[code]];
    if (axis !== undefined && down) this.hold.hold(code, axis.axis, axis.deflection);
    else if (axis !== undefined) this.hold.release(code);
    else if (grip !== undefined && down) this.hold.holdGrip(grip);
    else this.hold.releaseGrip();
  }
}
