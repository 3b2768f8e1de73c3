const KEY = 'reins.lease';

/** Whether the panel for driving by hand is open, and the lease that this window took: another one may drive, too. */
class Drive {
  open = $state(false);
  lease = $state<string | null>(sessionStorage.getItem(KEY));

  /** Remembers the lease across a reload of this tab, which is no reason to lose the controls. */
  took(lease: string): void {
    this.lease = lease;
    sessionStorage.setItem(KEY, lease);
  }

  forget(): void {
    this.lease = null;
    sessionStorage.removeItem(KEY);
  }

  /** Whoever sat here has signed out, or was shown out. */
  leave(): void {
    this.forget();
    this.open = false;
  }
}

export const drive = new Drive();
