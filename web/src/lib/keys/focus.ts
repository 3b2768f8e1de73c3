import { tick } from 'svelte';

/**
 * Gives the focus to a place, or else to the page, where what had it is gone or could not keep it: by keyboard one goes
 * on from there, and not from the top. Where something around the place has it, nobody is at anything else: that is where
 * a press on a button that was disabled just then leaves it.
 */
export async function goOnFrom(place: () => HTMLElement | null | undefined): Promise<void> {
  await tick();
  const active = document.activeElement;
  const next = place() ?? document.getElementById('page');
  if (active === null || active.contains(next)) next?.focus({ preventScroll: true });
}

export function goOnFromPage(): Promise<void> {
  return goOnFrom(() => null);
}
