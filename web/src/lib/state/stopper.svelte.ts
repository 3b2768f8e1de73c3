import { ApiError } from '../api/client';
import type { Cell } from '../api/documents';

const TRY_AGAIN_MS = 250;
const SAY_SO_MS = 10_000;

export type StopPhase = 'idle' | 'sending' | 'confirmed' | 'failed';

/**
 * Sends the emergency stop until the server confirms it; says plainly when it could not, and goes on trying until it is
 * told that whoever pressed it knows.
 */
export class Stopper {
  phase = $state<StopPhase>('idle');
  why = $state('');
  cell = $state<string | null>(null);
  /** Whether one that could not be confirmed is still being sent. */
  trying = $state(false);
  private presses = 0;
  /** Of each cell, the press that is being sent; none is given up for another cell's. */
  private newest: Record<string, number> = {};

  constructor(
    private readonly estop: (cell: string) => Promise<Cell>,
    private readonly now: () => number = () => performance.now(),
  ) {}

  async press(cell: string): Promise<void> {
    if (this.phase === 'sending' && this.cell === cell) return;
    this.cell = cell;
    this.phase = 'sending';
    this.presses += 1;
    const press = this.presses;
    this.newest[cell] = press;
    const until = this.now() + SAY_SO_MS;
    // Until it is pressed again, or whoever pressed it knows that it failed.
    while (this.newest[cell] === press) {
      const error = await this.send(cell);
      if (this.newest[cell] !== press) return;
      if (error === null) {
        if (this.cell === cell) this.phase = 'confirmed';
        return;
      }
      if (final(error) || this.now() >= until) this.failed(cell, error);
      if (final(error)) return;
      await new Promise((resolve) => setTimeout(resolve, TRY_AGAIN_MS));
    }
  }

  private failed(cell: string, error: Error): void {
    this.cell = cell;
    this.phase = 'failed';
    this.why = error.message;
    this.trying = !final(error);
  }

  private async send(cell: string): Promise<Error | null> {
    try {
      await this.estop(cell);
      return null;
    } catch (error) {
      return error instanceof Error ? error : new Error(String(error));
    }
  }

  /** The cell says itself that it is latched, or not any more. */
  settled(): void {
    if (this.phase === 'confirmed') this.phase = 'idle';
  }

  dismiss(): void {
    this.newest = {};
    this.phase = 'idle';
  }
}

/** The server understood and will not: trying again cannot help. */
function final(error: unknown): boolean {
  return error instanceof ApiError && error.problem.status >= 400 && error.problem.status < 500;
}
