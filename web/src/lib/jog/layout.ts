import { STOP_KEY } from '../keys/keys';

/** What is printed on a key, by its place (`KeyboardEvent.code`). */
export interface Layout {
  get(code: string): string | undefined;
}

/** What the keys that drive are called, in the order of what they do. */
export interface JogNames {
  turn: string;
  tool: string;
  lift: string;
  grip: string;
}

const PLACES: Record<keyof JogNames, readonly string[]> = {
  turn: ['KeyQ', 'KeyE'],
  tool: ['KeyI', 'KeyK', 'KeyJ', 'KeyL'],
  lift: ['KeyU', 'KeyO'],
  grip: ['BracketLeft', 'BracketRight'],
};
const BRACKETS: ReadonlyMap<string, string> = new Map([['BracketLeft', '['], ['BracketRight', ']']]);

/** The keyboard's layout, where the browser tells it; null where it does not, as most do not. */
export async function keyLayout(): Promise<Layout | null> {
  const { keyboard } = navigator as { keyboard?: { getLayoutMap?: () => Promise<Layout> } };
  try {
    return (await keyboard?.getLayoutMap?.()) ?? null;
  } catch {
    return null; // forbidden, as in a frame
  }
}

/** Names the keys that drive as they are printed on this keyboard; without a layout, on that of the US. */
export function jogNames(layout: Layout | null): JogNames {
  return Object.fromEntries(Object.entries(PLACES).map(([what, codes]) => [what, codes.map((code) => nameOf(code, layout)).join(' ')])) as unknown as JogNames;
}

function nameOf(code: string, layout: Layout | null): string {
  const printed = layout?.get(code) ?? BRACKETS.get(code) ?? code.slice('Key'.length);
  return printed === STOP_KEY ? '–' : printed.toUpperCase(); // there the stop is, and stays
}
