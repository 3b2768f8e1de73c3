import { tick } from 'svelte';

/** Gives the focus to the page where what had it is gone: by keyboard one goes on from there, and not from the top. */
export async function goOnFromPage(): Promise<void> {
  await tick();
  const active = document.activeElement;
  if (active === null || active === document.body) document.getElementById('page')?.focus({ preventScroll: true });
}
