/** What is pressed now, by finger, mouse or key, and the moment it is let go; never what it means. */
export class Presses {
  private readonly held = new Set<string>();
  private heard: readonly ((what: string) => void)[] = [];

  get now(): ReadonlySet<string> {
    return new Set(this.held);
  }

  down(what: string): void {
    this.held.add(what);
  }

  up(what: string): void {
    this.held.delete(what);
    this.heard.forEach((tell) => tell(what));
  }

  /** Nobody says of what is held that it was let go: the window lost the focus. */
  letGo(kind = ''): void {
    [...this.held].filter((what) => what.startsWith(kind)).forEach((what) => this.up(what));
  }

  /** Hears of everything that is let go; returns how to end that. */
  onUp(tell: (what: string) => void): () => void {
    this.heard = [...this.heard, tell];
    return () => {
      this.heard = this.heard.filter((known) => known !== tell);
    };
  }

  /** Listens before anything else on the page does. */
  attach(target: Window): () => void {
    const end = new AbortController();
    const how = { capture: true, signal: end.signal };
    const up = (event: PointerEvent): void => this.up(pointerOf(event));
    target.addEventListener('pointerdown', (event) => opensList(event.target) || this.down(pointerOf(event)), how);
    target.addEventListener('pointerup', up, how);
    target.addEventListener('pointercancel', up, how);
    // Of a scrollbar that is let go, a page hears nothing but that the mouse moves with no button down.
    target.addEventListener('pointermove', (event) => event.buttons === 0 && this.held.has(pointerOf(event)) && up(event), how);
    target.addEventListener('keydown', (event) => this.key(event, true), how);
    target.addEventListener('keyup', (event) => this.key(event, false), how);
    target.addEventListener('blur', (event) => event.target === target && this.letGo(), how); // and not what has the focus in it
    return () => end.abort();
  }

  private key(event: KeyboardEvent, down: boolean): void {
    // While Cmd is down, macOS says of no key that it was let go; of a lock it says so when the lock is.
    if (event.key === 'Meta' && !down) this.letGo(KEY);
    else if (!down) this.up(keyOf(event));
    else if (!event.key.endsWith('Lock') && !event.metaKey && !opensList(event.target)) this.down(keyOf(event));
  }
}

/** Whether a press opens a list there: Firefox then keeps from the page that it is let go of. */
function opensList(target: EventTarget | null): boolean {
  return (target as { tagName?: string } | null)?.tagName === 'SELECT';
}

const KEY = 'key ';

export function keyOf({ code }: Pick<KeyboardEvent, 'code'>): string {
  return `${KEY}${code}`;
}

export function pointerOf({ pointerId }: Pick<PointerEvent, 'pointerId'>): string {
  return `pointer ${pointerId}`;
}

export const presses = new Presses();
