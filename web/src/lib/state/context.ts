import { getContext, setContext } from 'svelte';
import type { Console } from './console.svelte';

const KEY = Symbol('console');

export function provideConsole(console: Console): void {
  setContext(KEY, console);
}

/** Returns the signed-in console; for components below `Shell`. */
export function useConsole(): Console {
  return getContext<Console>(KEY);
}
