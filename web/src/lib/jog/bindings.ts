import type { Axis, Grip } from './hold';

interface Pad {
  index: number;
  id: string;
  axes: readonly number[];
  buttons: readonly { value: number }[];
}

/** Physical keys (`KeyboardEvent.code`) while driving; none of them decides a question. */
export const JOG_KEYS: Record<string, { axis: Axis; deflection: 1 | -1 }> = {
  ArrowUp: { axis: 'base_x', deflection: 1 },
  ArrowDown: { axis: 'base_x', deflection: -1 },
  ArrowLeft: { axis: 'base_y', deflection: 1 },
  ArrowRight: { axis: 'base_y', deflection: -1 },
  KeyQ: { axis: 'base_yaw', deflection: 1 },
  KeyE: { axis: 'base_yaw', deflection: -1 },
  KeyI: { axis: 'tool_x', deflection: 1 },
  KeyK: { axis: 'tool_x', deflection: -1 },
  KeyJ: { axis: 'tool_y', deflection: 1 },
  KeyL: { axis: 'tool_y', deflection: -1 },
  KeyU: { axis: 'tool_z', deflection: 1 },
  KeyO: { axis: 'tool_z', deflection: -1 },
};

export const GRIP_KEYS: Record<string, Exclude<Grip, null>> = { BracketLeft: 'open', BracketRight: 'close' };

/** The letters that decide a question lie beside those that drive: whoever drives decides by a button. */
export const DECIDING_KEYS: readonly string[] = ['a', 'd', 's'];

/** Every key that drives: while somebody drives, it is no shortcut, whatever letter a keyboard has there. */
export const DRIVING_KEYS: readonly string[] = [...Object.keys(JOG_KEYS), ...Object.keys(GRIP_KEYS)];

const DEAD = 0.18;

/**
 * The gamepad that drives, and the name of one that does not, since nobody knows which of its buttons is which. The one at
 * the index `used` goes on driving, whichever comes beside it.
 */
export function standardPad<P extends { connected: boolean; mapping: string; id: string; index: number }>(pads: readonly (P | null)[], used: number | null): { pad: P | null; other: string } {
  const connected = pads.filter((one) => one?.connected === true);
  const standard = connected.filter((one) => one?.mapping === 'standard');
  const pad = standard.find((one) => one?.index === used) ?? standard[0] ?? null;
  return { pad, other: pad === null ? (connected[0]?.id ?? '') : '' };
}

/** The gamepads that are plugged in. Over plain HTTP a browser may know of none; one that may not say holds nothing. */
export function plugged(browser: Partial<Pick<Navigator, 'getGamepads'>>): readonly (Gamepad | null)[] {
  try {
    return browser.getGamepads?.() ?? [];
  } catch {
    return []; // a policy of the site's, as in a frame
  }
}

/** The gamepads of a page, of which one drives. */
export class Pads {
  private used: number | null = null;

  find<P extends { connected: boolean; mapping: string; id: string; index: number }>(pads: readonly (P | null)[]): { pad: P | null; other: string } {
    const found = standardPad(pads, this.used);
    this.used = found.pad?.index ?? null;
    return found;
  }
}

/** A gamepad's sticks as deflections: left drives the base, right the tool; triggers lift and lower, bumpers turn. */
export function gamepadAxes(pad: Pick<Pad, 'axes' | 'buttons'>): Record<Axis, number> {
  const axis = (k: number): number => {
    const value = pad.axes[k] ?? 0;
    return Math.abs(value) >= DEAD ? (value - Math.sign(value) * DEAD) / (1 - DEAD) : 0; // and where it is no number
  };
  const button = (k: number): number => pad.buttons[k]?.value ?? 0;
  const lift = button(7) - button(6);
  return {
    base_x: 0 - axis(1),
    base_y: 0 - axis(0),
    base_yaw: button(4) - button(5),
    tool_x: 0 - axis(3),
    tool_y: 0 - axis(2),
    tool_z: Math.abs(lift) < DEAD ? 0 : lift,
  };
}

/**
 * What a gamepad says, once it has been at rest: whatever let go of the robot (the window lost the focus, the link went,
 * the pad was unplugged, or another took its place), a stick that is still held starts nothing, as a key that is still held does not.
 */
export class Sticks {
  private rested = false;
  private of: string | null = null;
  /** Whether something is held that does not count, until it is let go. */
  ignored = false;

  /** Wants the sticks at rest before they count again. */
  letGo(): void {
    this.rested = false;
  }

  /** Returns the deflections that count; null while none do. */
  read(pad: Pad | null): Record<Axis, number> | null {
    const of = pad === null ? null : `${pad.index} ${pad.id}`;
    if (of === null || of !== this.of) this.letGo();
    this.of = of;
    const axes = pad === null ? null : gamepadAxes(pad);
    const held = axes !== null && Object.values(axes).some((value) => value !== 0);
    if (axes !== null && !held) this.rested = true;
    this.ignored = held && !this.rested;
    return this.rested ? axes : null;
  }
}
