import { ApiError, type Api } from '../api/client';
import { judge, type Integrity } from './integrity';

/** The log's integrity as this tab last found it; outlives the page that shows it. */
class LogCheck {
  now = $state.raw<Integrity>({ is: 'unchecked' });
  private seen: { size: number; root: string } | null = null;

  async run(api: Pick<Api, 'checkpoint' | 'verify'>): Promise<void> {
    if (this.now.is === 'checking') return;
    this.now = { is: 'checking' };
    try {
      const signed = await api.checkpoint();
      this.now = judge(signed, await api.verify(), this.seen, Date.now());
      if (this.now.is === 'good') this.seen = { size: this.now.size, root: this.now.root };
    } catch (error) {
      this.now = { is: 'unknown', why: error instanceof ApiError ? error.message : String(error), atMs: Date.now() };
    }
  }
}

export const logCheck = new LogCheck();
