export interface PadState {
  /** Whether something lies over the page. */
  covered: boolean;
  /** Whether what was held as the pad came has been let go. */
  ready: boolean;
  /** Whether anything is held that counts, and whether that asks for any motion. */
  running: boolean;
  moves: boolean;
  /** Why the newest command is not done; null: it is. */
  refused: string | null;
}

/** What is said above the pad of what is held. */
export function padWords({ covered, ready, running, moves, refused }: PadState): string {
  if (covered) return 'Nothing drives until the list over the page is closed';
  if (!ready) return 'Nothing drives yet: let go of everything';
  if (!running) return 'Hold to run; let go to stop';
  if (!moves) return 'Not moving: you hold opposite ways';
  return refused === null ? 'Moving while you hold' : 'Not moving';
}
