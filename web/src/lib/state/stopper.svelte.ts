import { ApiError, UNKNOWN } from '../api/client';
import type { Cell } from '../api/documents';
import { entryOf } from '../format/entry';

const TRY_AGAIN_MS = 250;
/** By then a server that is heard has answered; who is not answered says the stop on another line, too. */
export const OTHER_LINE_MS = 100;
const LINK_DOWN = 'The link is down.';

/** `sending`: for the first time, and nobody knows yet; `failed`: not confirmed, whether or not it is still sent. */
export type StopPhase = 'idle' | 'sending' | 'failed';

/** What became of the stop of one cell. */
export interface Stop {
  phase: StopPhase;
  why: string;
  /** Whether one that could not be confirmed is still being sent. */
  trying: boolean;
}

const NONE: Stop = { phase: 'idle', why: '', trying: false };

/**
 * Sends the emergency stop of a cell until the server confirms it; says plainly as soon as one attempt has failed, and
 * goes on trying until it is told that whoever pressed it knows. One of these knows of all cells, whatever page is open.
 */
export class Stopper {
  private stops = $state.raw<Record<string, Stop>>({});
  private presses = 0;
  /* eslint-disable svelte/prefer-svelte-reactivity -- nothing is drawn from these */
  /** Of each cell, the press that is being sent; none is given up for another cell's. */
  private readonly newest = new Map<string, number>();
  /** Of each cell, the press that waits for the server's answer. */
  private readonly asked = new Map<string, number>();
  /* eslint-enable svelte/prefer-svelte-reactivity */

  constructor(
    private readonly estop: (cell: string) => Promise<Cell>,
    private readonly linkDown: () => boolean = () => false,
    /** Another line, which answers nothing; said twice, a stop is no other than said once. */
    private readonly otherLine: (cell: string) => void = () => undefined,
  ) {}

  /** What became of the stop of this cell; idle where none was pressed, and once it is confirmed. */
  of(cell: string | null): Stop {
    return (cell === null ? undefined : entryOf(this.stops, cell)) ?? NONE;
  }

  /** The cells whose stop is not confirmed. */
  get unconfirmed(): string[] {
    return Object.keys(this.stops).filter((cell) => this.of(cell).phase === 'failed').sort();
  }

  /** What whoever leaves has to know of what they pressed here; null: nothing. */
  get leaving(): string | null {
    const cells = Object.keys(this.stops).sort();
    return cells.length === 0 ? null : `The stop of ${cells.join(', ')} is not confirmed. Use the emergency stop at the cell.`;
  }

  async press(cell: string): Promise<void> {
    if (this.newest.has(cell) && this.newest.get(cell) === this.asked.get(cell)) return;
    this.presses += 1;
    const press = this.presses;
    this.newest.set(cell, press);
    this.begun(cell);
    // Until it is pressed again, or whoever pressed it knows that it failed.
    while (this.newest.get(cell) === press) {
      this.asked.set(cell, press);
      const error = await this.send(cell);
      if (this.newest.get(cell) !== press) return;
      this.asked.delete(cell);
      if (error !== null) this.say(cell, { phase: 'failed', why: error.message, trying: !final(error) });
      if (error === null) this.dismiss(cell);
      if (error === null || final(error)) return;
      await new Promise((resolve) => setTimeout(resolve, TRY_AGAIN_MS));
    }
  }

  /** Whoever pressed it knows. */
  dismiss(cell: string): void {
    this.newest.delete(cell);
    this.stops = Object.fromEntries(Object.entries(this.stops).filter(([known]) => known !== cell));
  }

  /** One that is not confirmed is called so until it is, however often it is pressed. */
  private begun(cell: string): void {
    const failed = this.of(cell).phase === 'failed';
    if (this.linkDown()) this.say(cell, { phase: 'failed', why: LINK_DOWN, trying: true });
    else this.say(cell, failed ? { ...this.of(cell), trying: true } : { phase: 'sending', why: '', trying: false });
  }

  private say(cell: string, stop: Stop): void {
    this.stops = { ...this.stops, [cell]: stop };
  }

  private async send(cell: string): Promise<Error | null> {
    const late = setTimeout(() => this.otherLine(cell), OTHER_LINE_MS);
    try {
      await this.estop(cell);
      return null;
    } catch (error) {
      if (!final(error)) this.otherLine(cell);
      return error instanceof Error ? error : new Error(String(error));
    } finally {
      clearTimeout(late);
    }
  }
}

/** Whom the server does not let in, or a cell that it does not know. */
const FINAL: ReadonlySet<number> = new Set([401, 403, 404, 422]);

/** The server itself understood and will not: trying again cannot help. What a proxy says, or calls for later, is no such word. */
function final(error: unknown): boolean {
  return error instanceof ApiError && error.code !== UNKNOWN && FINAL.has(error.problem.status);
}
