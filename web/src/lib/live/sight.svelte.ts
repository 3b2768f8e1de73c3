import { untrack } from 'svelte';

/** Of a part that fits on the screen this share of it, of a longer one this share of the screen, is enough to have read on. */
const [OF_PART, OF_SCREEN] = [0.6, 0.5];
/** An observer speaks at shares of what it watches: these are near enough to tell pixels of a long card by. */
const SHARES = Array.from({ length: 41 }, (_, k) => k / 40);

interface Part {
  element: Element;
  here: boolean;
  seen: boolean;
}

/** Whether what is asked could be read where it stands: all its parts were on the screen, and one of them still is. */
export class Sight {
  private parts = $state.raw<readonly Part[]>([]);

  get read(): boolean {
    return this.parts.every((part) => part.seen) && this.parts.some((part) => part.here);
  }

  /** The first part that was never on the screen. */
  get unread(): Element | null {
    return this.parts.find((part) => !part.seen)?.element ?? null;
  }

  /** Watches one part; returns how to end that. */
  watch(element: Element): () => void {
    untrack(() => (this.parts = [...this.parts, { element, here: false, seen: false }])); // to watch is not to look
    const seen = new IntersectionObserver((entries) => {
      const entry = entries.at(-1);
      if (entry === undefined) return;
      const { boundingClientRect: whole, intersectionRect: shown, rootBounds: screen } = entry;
      this.note(element, entry.isIntersecting && shown.height >= Math.min(OF_PART * whole.height, OF_SCREEN * (screen?.height ?? Infinity)));
    }, { threshold: SHARES });
    seen.observe(element);
    return () => {
      seen.disconnect();
      this.parts = this.parts.filter((part) => part.element !== element);
    };
  }

  /** Notes whether enough of a part is on the screen. */
  note(element: Element, here: boolean): void {
    this.parts = this.parts.map((part) => (part.element === element ? { element, here, seen: part.seen || here } : part));
  }
}
