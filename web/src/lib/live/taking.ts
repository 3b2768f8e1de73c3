import type { Api } from '../api/client';

/** What taking the controls has to know of who asked for them. */
export interface Asking {
  readonly api: Pick<Api, 'takeOver' | 'takeCell' | 'release'>;
  /** Whether they look at this cell, where its controls would be. */
  looksAt(cell: string): boolean;
  /** Whether they have signed out. */
  gone(): boolean;
  took(lease: string): void;
  /** The controls of this cell came when nobody looked at it, and go back. */
  cameLate(cell: string): void;
}

/**
 * Takes the controls of a cell, or of the session that runs there, by what was seen up to the event `after`. Those of an
 * idle cell that come when nobody looks at it are given back at once. Those of a session are not: on that it would go
 * on. Who is still here may go back to it; left alone it waits for a person.
 */
export async function takeControls(of: Asking, cell: string, running: string | null, after: number): Promise<void> {
  const { lease, invocation } = await (running === null ? of.api.takeCell(cell, after) : of.api.takeOver(running, after));
  if (of.looksAt(cell) || (running !== null && !of.gone())) of.took(lease);
  else if (running === null && invocation !== null) {
    of.cameLate(cell);
    await of.api.release(invocation, 'end').catch(() => undefined); // what is not heard ends by itself
  }
}
