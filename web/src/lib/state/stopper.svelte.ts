import { ApiError } from '../api/client';
import type { Cell } from '../api/documents';

const TRY_AGAIN_MS = 250;
const GIVE_UP_MS = 10_000;

export type StopPhase = 'idle' | 'sending' | 'confirmed' | 'failed';

/** Sends the emergency stop until the server confirms it; says plainly when it could not. */
export class Stopper {
  phase = $state<StopPhase>('idle');
  why = $state('');
  cell = $state<string | null>(null);

  constructor(
    private readonly estop: (cell: string) => Promise<Cell>,
    private readonly now: () => number = () => performance.now(),
  ) {}

  async press(cell: string): Promise<void> {
    if (this.phase === 'sending' && this.cell === cell) return;
    this.cell = cell;
    this.phase = 'sending';
    const until = this.now() + GIVE_UP_MS;
    for (;;) {
      try {
        await this.estop(cell);
        this.phase = 'confirmed';
        return;
      } catch (error) {
        this.why = error instanceof Error ? error.message : String(error);
        if (final(error) || this.now() >= until) {
          this.phase = 'failed';
          return;
        }
        await new Promise((resolve) => setTimeout(resolve, TRY_AGAIN_MS));
      }
    }
  }

  /** The cell says itself that it is latched, or not any more. */
  settled(): void {
    if (this.phase === 'confirmed') this.phase = 'idle';
  }

  dismiss(): void {
    this.phase = 'idle';
  }
}

/** The server understood and will not: trying again cannot help. */
function final(error: unknown): boolean {
  return error instanceof ApiError && error.problem.status >= 400 && error.problem.status < 500;
}
