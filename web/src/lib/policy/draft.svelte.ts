import { ApiError, type Api } from '../api/client';
import type { Version } from '../api/documents';
import { candidateOf, filesOf, inOrder, read, standings, type Candidate, type Fault, type Files } from './candidate';
import { said } from './versions.svelte';

/** The candidate that is being brought; it outlives the page that shows it, as long as the tab. */
export class Draft {
  files = $state.raw<Files>({});
  live = $state.raw<Files>({});
  leftOut = $state.raw<string[]>([]);
  partial = $state(false);
  /** The version whose files `live` are. */
  of = $state<string | null>(null);
  faults = $state.raw<Fault[]>([]);
  chosen = $state<string | null>(null);
  why = $state('');
  trouble = $state<string | null>(null);
  busy = $state<'reading' | 'checking' | null>(null);
  /** The version that was kept of it while it was changed, or nobody saw; until somebody looks at it. */
  kept = $state.raw<Version | null>(null);
  /** Whether `kept` was known before, with the reason of whoever brought it first: what was said this time is nowhere. */
  known = $state(false);
  private taking = 0;
  /** The files as they were taken: what differs was written here. */
  private taken = $state.raw<Files>({});
  /** Who writes it. */
  private by: string | null = null;

  get empty(): boolean {
    return Object.keys(this.files).length === 0;
  }

  /** Whether something was written here, which another take would replace. */
  get written(): boolean {
    return Object.entries(this.files).some(([path, text]) => text !== this.taken[path]);
  }

  get listed(): ReturnType<typeof standings> {
    return standings(this.files, this.live);
  }

  /** What whoever leaves the page has to know of it; null: it differs in nothing from what is in force. */
  get leaving(): string | null {
    if (this.busy === 'checking') return 'The policy that you brought was still being checked: whether it was kept stands under Versions.';
    return !this.empty && (this.why.trim() !== '' || this.listed.some(({ standing }) => standing !== 'same')) ? 'The policy that you were about to bring was not sent, and is gone.' : null;
  }

  /** Is written by this person from now on: what somebody else left in the tab is nothing for them to bring. */
  belongsTo(name: string): void {
    if (this.by !== null && this.by !== name) {
      this.clear();
      this.kept = this.busy = null;
    }
    this.by = name;
  }

  clear(): void {
    this.keep();
    this.files = {};
    this.faults = [];
    this.leftOut = [];
    this.chosen = null;
    this.trouble = null;
    this.why = '';
  }

  /** Takes what was picked; none: begins with what is in force, which is asked for anew, as what a page has heard is absent or old. */
  async take(picked: File[], api: Pick<Api, 'versions' | 'policyFiles'>): Promise<void> {
    const mine = ++this.taking;
    this.busy = 'reading';
    this.trouble = null;
    this.faults = [];
    try {
      const [texts, { active }] = await Promise.all([read(picked), api.versions(1)]);
      const live = filesOf(await api.policyFiles(active));
      if (mine === this.taking) this.begin(candidateOf(texts, live), live, active);
    } catch (error) {
      if (mine === this.taking) this.trouble = said(error);
    }
    if (mine === this.taking) this.busy = null;
  }

  write(path: string, text: string): void {
    this.keep();
    this.files = { ...this.files, [path]: text };
  }

  /**
   * Has the server check it, and says which version it is kept as (`kept`), where there are no faults.
   *
   * That takes a while, in which it may be changed: only as it was sent it has been brought, and goes.
   */
  async bring(api: Pick<Api, 'propose'>): Promise<void> {
    const sent = { files: this.files, why: this.why };
    const { by } = this;
    this.busy = 'checking';
    this.trouble = null;
    this.kept = null;
    try {
      const kept = await api.propose(sent.files, sent.why.trim());
      if (by !== this.by) return; // whoever sits here by now has brought nothing
      this.kept = kept;
      this.known = kept.why !== sent.why.trim();
      this.faults = [];
      if (this.still(sent)) this.clear();
    } catch (error) {
      if (by !== this.by) return;
      this.refused(error, this.still(sent));
    }
    this.busy = null;
  }

  /** Has nothing replace it that is still being read. */
  private keep(): void {
    this.taking += 1;
    if (this.busy === 'reading') this.busy = null;
  }

  private still({ files, why }: { files: Files; why: string }): boolean {
    const names = Object.keys(files);
    return why === this.why && names.length === Object.keys(this.files).length && names.every((name) => files[name] === this.files[name]);
  }

  private begin(found: Candidate, live: Files, of: string): void {
    [this.live, this.of] = [live, of];
    this.files = this.taken = found.files;
    this.leftOut = found.leftOut;
    this.partial = found.partial;
    this.chosen = this.listed.find(({ standing }) => standing === 'new' || standing === 'changed')?.path ?? this.listed[0]?.path ?? null;
  }

  /** Leads to the first fault, but nobody away from what they write meanwhile. */
  private refused(error: unknown, lead: boolean): void {
    if (!(error instanceof ApiError) || error.code !== 'policy_invalid') {
      this.trouble = said(error);
      return;
    }
    this.faults = inOrder((error.problem.errors ?? []).map(({ field, message, file, line }) => ({ file: file ?? '', line: line ?? 0, field, message })));
    if (lead) this.chosen = this.faults.find(({ file }) => file in this.files)?.file ?? this.chosen;
  }
}

export const draft = new Draft();
