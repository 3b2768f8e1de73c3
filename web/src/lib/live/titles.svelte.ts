import { ApiError, type Api } from '../api/client';
import type { Invocation, Params, Review } from '../api/documents';
import { entryOf } from '../format/entry';
import { titleOf, words } from '../format/capability';

/** So many are asked for at once: what a person asks for meanwhile has a connection of its own. */
const AT_ONCE = 2;

/** What the sessions under review were about, also of those that a console does not keep: asked for, and remembered as long as they are shown. */
export class Titles {
  /** Null where the server has no answer: asking again would bring none. */
  private known = $state.raw<Readonly<Record<string, Params | null>>>({});
  private wanted: readonly string[] = [];
  private asking = false;

  constructor(private readonly api: Pick<Api, 'invocation'>) {}

  of({ invocation, capability }: Review): string {
    const about = entryOf(this.known, invocation) ?? null;
    return about === null ? words(capability) : titleOf(capability, about);
  }

  /** Takes what is shown now; what is told of sessions anyway is not asked for. */
  want(reviews: readonly Review[], told: Readonly<Record<string, Invocation>>): void {
    this.wanted = reviews.map((review) => review.invocation);
    const found = this.wanted.flatMap((id): [string, Params | null][] => {
      const session = entryOf(told, id);
      const about = session === undefined ? entryOf(this.known, id) : aboutOf(session);
      return about === undefined ? [] : [[id, about]];
    });
    this.known = Object.fromEntries(found);
    void this.ask();
  }

  private async ask(): Promise<void> {
    if (this.asking) return;
    this.asking = true;
    for (let next = this.next(); next.length > 0; next = this.next()) {
      const answers = await Promise.all(next.map((id) => this.about(id)));
      const found = answers.filter((answer) => answer !== undefined);
      this.known = { ...this.known, ...Object.fromEntries(found) };
      if (found.length < answers.length) break; // no server: what is shown next asks again
    }
    this.asking = false;
  }

  private next(): string[] {
    return this.wanted.filter((id) => !Object.hasOwn(this.known, id)).slice(0, AT_ONCE);
  }

  private async about(id: string): Promise<[string, Params | null] | undefined> {
    try {
      return [id, aboutOf(await this.api.invocation(id))];
    } catch (error) {
      return error instanceof ApiError && error.code !== 'unreachable' ? [id, null] : undefined;
    }
  }
}

function aboutOf(session: Invocation): Params {
  return session.effective ?? session.requested;
}
