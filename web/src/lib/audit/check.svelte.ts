import { ApiError, type Api } from '../api/client';
import { clock } from '../state/clock.svelte';
import { judge, type Integrity } from './integrity';

/** The log's integrity as this tab last found it; outlives the page that shows it. */
export class LogCheck {
  now = $state.raw<Integrity>({ is: 'unchecked' });
  private seen: { size: number; root: string } | null = null;

  /** Checks what is not known, or was found of a log of another length than `seq`, be it shorter by now; what an answer says is bad stays so. */
  async runUnlessHolds(api: Pick<Api, 'checkpoint' | 'verify'>, seq: number): Promise<void> {
    if (this.now.is === 'unchecked' || this.now.is === 'unknown' || (this.now.is === 'good' && this.now.size !== seq)) await this.run(api);
  }

  async run(api: Pick<Api, 'checkpoint' | 'verify'>): Promise<void> {
    const before = this.now;
    if (before.is === 'checking') return;
    this.now = { is: 'checking' };
    try {
      const signed = await api.checkpoint();
      this.now = judge(signed, await api.verify(), this.seen, clock.read());
      if (this.now.is === 'good') this.seen = { size: this.now.size, root: this.now.root };
    } catch (error) {
      // No answer takes back what one has said.
      this.now = before.is === 'bad' ? before : { is: 'unknown', why: error instanceof ApiError ? error.message : String(error), atMs: clock.read() };
    }
  }
}

export const logCheck = new LogCheck();
