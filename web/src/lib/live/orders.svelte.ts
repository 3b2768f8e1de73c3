import { type Api, ApiError, refusedWords } from '../api/client';
import type { Cell, Invocation } from '../api/documents';
import type { Documents } from '../state/documents';
import { holdersOf, restraintsOf } from './control';
import { deniedIsUndone } from './held';

type Word = 'pause' | 'resume' | 'rollback';
const SAYS: Record<Word, string> = { pause: 'Pause', resume: 'Resume', rollback: 'Roll back' };

/** A word is taken to be on its way, and nothing worth a line, for so long. */
const SOON_MS = 400;
/** What a session does after a word is shown by then. */
const SHOWN_MS = 3_000;

interface Refusal {
  cell: string | null;
  word: Word;
  why: string;
}

/** What is looked at, by whom, and whether it is the present. */
interface InSight {
  readonly session: Invocation | null;
  readonly cell: Cell | null;
  readonly live: boolean;
  readonly me: { readonly role: string } | null;
  readonly docs: Documents;
  readonly api: Api;
}

/** What may be ordered of the session that one looks at, and what became of it; for every button that orders it, on whatever page. */
export class Orders {
  /** What was refused last in each cell. */
  private refused = $state.raw<readonly Refusal[]>([]);
  /** What was ordered of which session, and has had no answer for a while. */
  private waiting = $state.raw<readonly { session: string; word: Word }[]>([]);

  /** Which session was told last to go on: it may move, whatever is shown of it still. */
  private loosened = $state.raw<{ session: string } | null>(null);

  constructor(private readonly sight: InSight) {}

  private readonly status = $derived.by(() => {
    const { session, cell } = this.sight;
    return session !== null && cell?.busy === session.id ? session.status : null;
  });
  private readonly operates = $derived.by(() => this.sight.me?.role === 'operator');
  // Nobody lets a robot go on that is not heard: it could not be told, and what is shown of it is old.
  private readonly may = $derived.by(() => this.sight.live && this.sight.cell?.online === true && this.operates);
  private readonly restraints = $derived.by(() => restraintsOf(this.status, holdersOf(this.sight.cell)));
  // A session that its cell says to move again may be paused, whatever the record of it says still, and one that was told
  // to from here: no pause is lost, nor where what is shown is not the present. The server decides, and where it does not
  // answer, that is said.
  readonly pausable = $derived.by(() => {
    const { cell, session } = this.sight;
    const moves = this.status !== null && restraintsOf(cell?.status ?? null, holdersOf(cell)).pausable;
    const goesOn = this.status !== null && session?.id === this.loosened?.session;
    return this.operates && (moves || goesOn || this.restraints.pausable);
  });
  readonly resumable = $derived.by(() => this.may && this.restraints.resumable);
  // A rollback is had once, and nobody rolls back what somebody else drives. Where a denial of what the session asks is
  // its rollback, the question's own button says so, and there is no other.
  readonly undoable = $derived.by(() => {
    const { session, cell, docs } = this.sight;
    if (!this.may || session === null || cell?.control != null) return false;
    if (deniedIsUndone(Object.values(docs.escalations), session.id)) return false;
    if (docs.events.some((event) => event.invocation === session.id && event.kind === 'recovery' && event.body['strategy'] === 'rollback')) return false;
    return this.status === 'running' || this.status === 'paused' || this.status === 'escalated';
  });

  /** What was ordered of the session that one looks at, and has had no answer for a while. */
  get unanswered(): Word | null {
    return this.waiting.findLast(({ session }) => session === this.sight.session?.id)?.word ?? null;
  }

  /** Why what was ordered was not done; who looks at another cell by now is told of which it was ordered. */
  get problem(): string {
    const here = this.sight.cell?.id ?? null;
    return this.refused.map((one) => (one.cell === here ? one.why : named(one))).join(' ');
  }

  /** The same for who does not see where it was ordered. */
  get told(): string {
    return this.refused.map(named).join(' ');
  }

  understood(): void {
    this.refused = [];
  }

  pause(): void {
    if (this.pausable) void this.say('pause');
  }

  resume(): void {
    if (this.resumable) void this.say('resume');
  }

  rollBack(): void {
    if (this.undoable) void this.say('rollback');
  }

  /**
   * Has a session told to go on. From then on it may be paused: until the server says that it does not, or what it does is
   * shown; without an answer for good.
   */
  async letting<T>(session: string, tell: () => Promise<T>): Promise<T> {
    const loosened = (this.loosened = { session });
    const shown = (): void => {
      if (this.loosened === loosened) this.loosened = null;
    };
    try {
      const told = await tell();
      setTimeout(shown, SHOWN_MS);
      return told;
    } catch (error) {
      if (error instanceof ApiError && error.code !== 'unreachable') shown();
      throw error;
    }
  }

  private async say(word: Word): Promise<void> {
    const { session } = this.sight;
    if (session === null) return;
    const { id } = session;
    const cell = session.cell ?? null;
    this.refused = this.refused.filter((one) => one.cell !== cell);
    const late = setTimeout(() => (this.waiting = [...this.waiting, { session: id, word }]), SOON_MS);
    const { api, docs } = this.sight;
    try {
      if (word === 'pause') await api.restrain(id, word);
      else await this.letting(id, () => api.loosen(id, word, docs.seq));
    } catch (error) {
      const why = refusedWords(error);
      this.refused = [...this.refused.filter((one) => one.cell !== cell), { cell, word, why }];
    }
    clearTimeout(late);
    this.waiting = this.waiting.filter((one) => one.session !== id || one.word !== word);
  }
}

function named({ cell, word, why }: Refusal): string {
  return `${SAYS[word]} in ${cell ?? 'no cell'}: ${why}`;
}
