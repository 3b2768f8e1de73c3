import { tab } from './tab';

const KEY = 'reins.lease';
const KEY_N = 'reins.lease.n';
/** More than is said between the number that is stored and the end of the page: it lets go of what it held. */
const LAST_WORDS = 100;
/** A page that is being left holds its lock for a moment longer. */
const LEAVING_MS = 500;

/** Whether the panel for driving by hand is open, and the lease that this window took: another one may drive, too. */
class Drive {
  open = $state(false);
  lease = $state<string | null>(null);
  private letGo: () => void = () => undefined;
  /** A lease takes no command whose number is not newer, and the clock that a first number comes from may be set back. */
  private n = Math.max(Date.now(), (Number(tab.read(KEY_N)) || 0) + LAST_WORDS);

  constructor() {
    addEventListener('pagehide', () => {
      if (this.lease !== null) tab.write(KEY_N, String(this.n));
    });
    const kept = tab.read(KEY);
    if (kept === null) return;
    void this.hold(kept).then((alone) => {
      if (tab.read(KEY) !== kept) return; // another was taken meanwhile, or whoever had it has left
      if (alone) this.lease ??= kept;
      else tab.drop(KEY);
    });
  }

  /** Whether the panel may be opened or closed: where no cell is known, there is nothing to drive. */
  toggles(cell: string | null): boolean {
    return this.open || cell !== null;
  }

  /** Opens the panel, or closes it, where it may be. */
  toggle(cell: string | null): void {
    if (this.toggles(cell)) this.open = !this.open;
  }

  /** The number of the next command: it rises as long as the lease lives, over a reload and a look at another page. */
  next(): number {
    this.n += 1;
    return this.n;
  }

  /** Remembers the lease across a reload of this tab, which is no reason to lose the controls. */
  took(lease: string): void {
    this.letGo();
    this.lease = lease;
    tab.write(KEY, lease);
    void this.hold(lease);
  }

  forget(): void {
    this.letGo();
    this.lease = null;
    tab.drop(KEY);
  }

  /** Says whether this window alone has the lease: one that was duplicated remembers it, too, and has to ask. */
  private async hold(lease: string): Promise<boolean> {
    // Where the page came over plain HTTP from elsewhere, browsers have no locks.
    if (!('locks' in navigator)) return true;
    return new Promise((resolve) => {
      const held = (): Promise<void> => {
        resolve(true);
        return new Promise((over) => (this.letGo = over));
      };
      navigator.locks.request(`${KEY}.${lease}`, { signal: AbortSignal.timeout(LEAVING_MS) }, held).catch(() => resolve(false));
    });
  }

  /** Whoever sat here has signed out, or was shown out. */
  leave(): void {
    this.forget();
    this.open = false;
  }
}

export const drive = new Drive();
