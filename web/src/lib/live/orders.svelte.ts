import type { Console } from '../state/console.svelte';
import { holdersOf, restraintsOf } from './control';
import { deniedIsUndone } from './held';

type Word = 'pause' | 'resume' | 'rollback';
const SAYS: Record<Word, string> = { pause: 'Pause', resume: 'Resume', rollback: 'Roll back' };

/** A word is taken to be on its way, and nothing worth a line, for so long. */
const SOON_MS = 400;

/** What may be ordered of the session that one looks at, and what became of it; for every button that orders it. */
export class Orders {
  private refused = $state.raw<{ cell: string | null; word: Word; why: string } | null>(null);
  /** What was ordered, and has had no answer for a while. */
  unanswered = $state.raw<Word | null>(null);

  constructor(private readonly console: Console) {}

  private readonly status = $derived.by(() => {
    const { session, cell } = this.console;
    return session !== null && cell?.busy === session.id ? session.status : null;
  });
  private readonly may = $derived.by(() => this.console.live && this.console.me?.role === 'operator');
  private readonly restraints = $derived.by(() => restraintsOf(this.status, holdersOf(this.console.cell)));
  // A session that its cell says to move again may be paused, whatever the record of it says still: no pause is lost.
  readonly pausable = $derived.by(() => {
    const { cell } = this.console;
    const moves = this.status !== null && restraintsOf(cell?.status ?? null, holdersOf(cell)).pausable;
    return this.may && (moves || this.restraints.pausable);
  });
  readonly resumable = $derived.by(() => this.may && this.restraints.resumable);
  // A rollback is had once, and nobody rolls back what somebody else drives. Where a denial of what the session asks is
  // its rollback, the question's own button says so, and there is no other.
  readonly undoable = $derived.by(() => {
    const { session, cell, docs } = this.console;
    if (!this.may || session === null || cell?.control != null) return false;
    if (deniedIsUndone(Object.values(docs.escalations), session.id)) return false;
    if (docs.events.some((event) => event.invocation === session.id && event.kind === 'recovery' && event.body['strategy'] === 'rollback')) return false;
    return this.status === 'running' || this.status === 'paused' || this.status === 'escalated';
  });

  /** Why what was ordered last was not done; who looks at another cell by now is told of which it was ordered. */
  get problem(): string {
    if (this.refused === null) return '';
    const { cell, word, why } = this.refused;
    return cell === (this.console.cell?.id ?? null) ? why : `${SAYS[word]} in ${cell ?? 'no cell'}: ${why}`;
  }

  understood(): void {
    this.refused = null;
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

  private async say(word: Word): Promise<void> {
    const { session } = this.console;
    if (session === null) return;
    this.refused = null;
    const late = setTimeout(() => (this.unanswered = word), SOON_MS);
    try {
      await this.console.api.operate(session.id, word);
    } catch (error) {
      this.refused = { cell: session.cell ?? null, word, why: error instanceof Error ? error.message : String(error) };
    }
    clearTimeout(late);
    this.unanswered = null;
  }
}
