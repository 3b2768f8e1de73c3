import { tick } from 'svelte';

/**
 * Gives the focus to a place, or else to the page, where what had it is gone or could not keep it: by keyboard one goes
 * on from there, and not from the top.
 */
export async function goOnFrom(place: () => HTMLElement | null | undefined): Promise<void> {
  await tick();
  const active = document.activeElement;
  if (active === null || active === document.body) (place() ?? document.getElementById('page'))?.focus({ preventScroll: true });
}

export function goOnFromPage(): Promise<void> {
  return goOnFrom(() => null);
}
