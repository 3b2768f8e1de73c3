import { ApiError, UNKNOWN } from '../api/client';
import type { Cell } from '../api/documents';
import { entryOf } from '../format/entry';

const TRY_AGAIN_MS = 250;
/** By then a server that is heard has answered; who is not answered says the stop on another line, too. */
export const OTHER_LINE_MS = 100;
/** By then an answer is due. It counts all the same whenever it comes: over a slow link a stop may long be obeyed. */
export const DUE_MS = 1_500;
/** So many attempts of one press are on their way at a time: what the server hears twice it records twice. */
const AT_ONCE = 2;
const LINK_DOWN = 'The link is down.';
const NO_ANSWER = 'The server has not answered yet.';

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

/** What a stop has to do with besides the server's answer. */
interface Around {
  linkDown?: () => boolean;
  /** Another line, which answers nothing; said twice, a stop is no other than said once. */
  otherLine?: (cell: string) => void;
  /** Up to which event of the record this page has heard. */
  seen?: () => number;
  /** Comes once this page shows a cell to be stopped, or cannot be waited for any longer. */
  shown?: (cell: string) => Promise<void>;
}

/** A stop that is being sent; pressed again before it is confirmed, it is still the same. */
interface Press {
  /** The newest event that was known when it was pressed. */
  after: number;
  /** The attempts that have no answer yet. */
  open: Set<Promise<unknown>>;
  /** Whether the newest attempt may still be answered in time. */
  due: boolean;
  /** Ends the wait between two attempts. */
  hurry: () => void;
}

/**
 * Sends the emergency stop of a cell until it is confirmed: by the server's answer, however late, or by the record of
 * it. Says plainly as soon as one attempt has failed or is overdue, and goes on trying until it is told that whoever
 * pressed it knows. One of these knows of all cells, whatever page is open.
 */
export class Stopper {
  private stops = $state.raw<Record<string, Stop>>({});
  /** Of each cell, the press that is being sent; none is given up for another cell's. */
  // eslint-disable-next-line svelte/prefer-svelte-reactivity -- nothing is drawn from it
  private readonly newest = new Map<string, Press>();
  private readonly linkDown: () => boolean;
  private readonly otherLine: (cell: string) => void;
  private readonly seen: () => number;
  private readonly shown: (cell: string) => Promise<void>;

  constructor(private readonly estop: (cell: string) => Promise<Cell>, around: Around = {}) {
    this.linkDown = around.linkDown ?? (() => false);
    this.otherLine = around.otherLine ?? (() => undefined);
    this.seen = around.seen ?? (() => 0);
    this.shown = around.shown ?? (() => Promise.resolve());
  }

  /** What became of the stop of this cell; idle where none was pressed, and once it is confirmed. */
  of(cell: string | null): Stop {
    return (cell === null ? undefined : entryOf(this.stops, cell)) ?? NONE;
  }

  /** The cells whose stop was pressed here, and is not confirmed yet. */
  get pressed(): string[] {
    return Object.keys(this.stops).sort();
  }

  /** Of these, the ones that should be by now. */
  get unconfirmed(): string[] {
    return this.pressed.filter((cell) => this.of(cell).phase === 'failed');
  }

  /** What whoever leaves has to know of what they pressed here; null: nothing. */
  get leaving(): string | null {
    return this.pressed.length === 0 ? null : `The stop of ${this.pressed.join(', ')} is not confirmed. Use the emergency stop at the cell.`;
  }

  async press(cell: string): Promise<void> {
    const known = this.newest.get(cell);
    if (known === undefined) await this.insist(cell);
    else if (!known.due) this.again(cell, known);
  }

  /** Whoever pressed it knows. */
  dismiss(cell: string): void {
    this.newest.delete(cell);
    this.stops = Object.fromEntries(Object.entries(this.stops).filter(([known]) => known !== cell));
  }

  /** The record says that a stop of this person's was obeyed, by an event of that number. */
  recorded(cell: string, seq: number): void {
    const press = this.newest.get(cell);
    if (press !== undefined && seq > press.after) this.dismiss(cell);
  }

  /** The other line is there again: what was sent while it was not may hang for long, and said there it comes at once. */
  linked(): void {
    this.newest.forEach((_, cell) => this.otherLine(cell));
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

  /** Until it is confirmed, or whoever pressed it knows that it failed. */
  private async insist(cell: string): Promise<void> {
    // eslint-disable-next-line svelte/prefer-svelte-reactivity -- nothing is drawn from it
    const press: Press = { after: this.seen(), open: new Set(), due: false, hurry: () => undefined };
    this.newest.set(cell, press);
    this.begun(cell);
    while (this.newest.get(cell) === press) {
      if (press.open.size < AT_ONCE) await this.attempt(cell, press);
      else await Promise.race(press.open);
      if (this.newest.get(cell) === press) {
        await new Promise<void>((resolve) => {
          press.hurry = resolve;
          setTimeout(resolve, TRY_AGAIN_MS);
        });
      }
    }
  }

  private again(cell: string, press: Press): void {
    this.begun(cell);
    if (press.open.size >= AT_ONCE) this.otherLine(cell);
    press.hurry();
  }

  /** Sends it once; over when it is answered, or overdue. */
  private async attempt(cell: string, press: Press): Promise<void> {
    const late = setTimeout(() => this.otherLine(cell), OTHER_LINE_MS);
    press.due = true;
    const answered = this.estop(cell)
      .then(() => null, (error: unknown) => (error instanceof Error ? error : new Error(String(error))))
      .then((error) => {
        clearTimeout(late);
        press.open.delete(answered);
        this.settle(cell, press, error);
        return 'answered';
      });
    press.open.add(answered);
    const overdue = new Promise((resolve) => setTimeout(resolve, DUE_MS));
    const how = await Promise.race([answered, overdue]);
    press.due = false;
    if (this.newest.get(cell) !== press) return;
    if (how === 'answered') this.otherLine(cell);
    else this.say(cell, { phase: 'failed', why: this.linkDown() ? LINK_DOWN : NO_ANSWER, trying: true });
  }

  /** Takes an answer, in time or late. */
  private settle(cell: string, press: Press, error: Error | null): void {
    if (this.newest.get(cell) !== press) return;
    if (error === null || final(error)) this.newest.delete(cell);
    if (error === null) void this.confirmed(cell);
    else this.say(cell, { phase: 'failed', why: error.message, trying: !final(error) });
  }

  /** Between the answer and the page that shows what it says, a stop is under way: nobody takes it for not pressed. */
  private async confirmed(cell: string): Promise<void> {
    this.say(cell, { phase: 'sending', why: '', trying: false });
    await this.shown(cell);
    if (!this.newest.has(cell)) this.dismiss(cell); // else it was pressed again
  }
}

/** Whom the server does not let in, or a cell that it does not know. */
const FINAL: ReadonlySet<number> = new Set([401, 403, 404, 422]);

/** The server itself understood and will not: trying again cannot help. What a proxy says, or calls for later, is no such word. */
function final(error: unknown): boolean {
  return error instanceof ApiError && error.code !== UNKNOWN && FINAL.has(error.problem.status);
}
