import { tick } from 'svelte';
import type { Attachment } from 'svelte/attachments';

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

/** Over what goes by itself, or once it is pressed: whoever was at it goes on from the place, or else from the page. */
export function goesOn(place: (from: HTMLElement) => HTMLElement | null = () => null): Attachment<HTMLElement> {
  return (element) => {
    const next = place(element);
    return () => void goOnFrom(() => (next?.isConnected === true ? next : null));
  };
}

/**
 * The same where something around the place has the focus: nobody is at anything else there. That is where a press leaves
 * it on a button that was disabled just then.
 */
export async function goInFrom(place: () => HTMLElement | null | undefined): Promise<void> {
  await tick();
  const next = place() ?? document.getElementById('page');
  if (document.activeElement?.contains(next) ?? true) next?.focus({ preventScroll: true });
}
