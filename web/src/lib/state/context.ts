import { getContext, setContext } from 'svelte';
import type { Console } from './console.svelte';
import type { Stopper } from './stopper.svelte';

const CONSOLE = Symbol('console');
const STOPPER = Symbol('stopper');

export function provideConsole(console: Console): void {
  setContext(CONSOLE, console);
}

/** Returns the signed-in console; for components below `Shell`. */
export function useConsole(): Console {
  return getContext<Console>(CONSOLE);
}

export function provideStopper(stopper: Stopper): void {
  setContext(STOPPER, stopper);
}

/** Returns what sends the stop of every cell; for components below `Shell`. */
export function useStopper(): Stopper {
  return getContext<Stopper>(STOPPER);
}
