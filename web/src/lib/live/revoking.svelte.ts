import { ApiError, type Api } from '../api/client';

/** The grants that are being revoked from here, and those that could not be; it outlives the page that it was asked on. */
export class Revoking {
  private under: readonly string[] = $state.raw([]);
  refused: readonly { id: string; why: string }[] = $state.raw([]);

  constructor(private readonly api: Pick<Api, 'revoke'>) {}

  /** Whether it has been asked for, and has no answer yet. */
  asked(id: string): boolean {
    return this.under.includes(id);
  }

  async revoke(id: string): Promise<void> {
    this.refused = this.refused.filter((one) => one.id !== id);
    this.under = [...this.under, id];
    try {
      await this.api.revoke(id);
      this.refused = this.refused.filter((one) => one.id !== id);
    } catch (error) {
      this.refused = [...this.refused.filter((one) => one.id !== id), { id, why: whyOf(error) }];
    }
    const at = this.under.indexOf(id);
    this.under = this.under.filter((_, k) => k !== at);
  }
}

/** What to say of a grant that may stand still: behind its name. */
function whyOf(error: unknown): string {
  const why = error instanceof Error ? error.message : String(error);
  return error instanceof ApiError && error.code === 'unreachable' ? `: ${why}` : ` is not revoked: ${why}`;
}
