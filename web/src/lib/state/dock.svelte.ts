import type { Snippet } from 'svelte';

/** What stands above the stop on a phone, in the bar that never scrolls: the answers to the question that is open. */
class Dock {
  answers = $state.raw<Snippet | null>(null);
}

export const dock = new Dock();
