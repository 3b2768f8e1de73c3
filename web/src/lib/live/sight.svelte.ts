import { untrack } from 'svelte';

/** Parts are lines: one is read where all of it is on the screen; of one that is higher than what is left for it there, this share of that. */
const OF_ROOM = 0.5;
/** Where a line ends between two pixels. */
const ROUNDED_PX = 1;
/** An observer speaks at shares of what it watches: these are near enough to tell pixels of a long line by. */
const SHARES = [...Array.from({ length: 41 }, (_, k) => k / 40), 0.985, 0.995];

/** What was there for a moment alone, before the answers took their place or as one scrolled past, was read by nobody. */
export const READ_MS = 300;

const FOLLOWS: ReadonlySet<number> = new Set([4, 20]); // Node.DOCUMENT_POSITION_FOLLOWING, which may be within it

interface Part {
  element: Element;
  here: boolean;
  seen: boolean;
}

/** Whether a line can be read: what of it is on the screen, px, of how much, and how much can be at once. */
export function inSight(meets: boolean, wholePx: number, shownPx: number, roomPx: number): boolean {
  return meets && shownPx >= (wholePx > roomPx ? OF_ROOM * roomPx : wholePx - ROUNDED_PX);
}

/** How much of an element can be on the screen at once, px: what it is scrolled in is lower than that, by the bar with the stop. */
function roomOf(element: Element): number {
  let room = window.innerHeight;
  for (let around = element.parentElement; around !== null; around = around.parentElement) {
    if (/auto|scroll/.test(getComputedStyle(around).overflowY)) room = Math.min(room, around.clientHeight);
  }
  return room;
}

/** Whether what is asked could be read where it stands: all its parts were on the screen for a while, and one of them still is. */
export class Sight {
  private parts = $state.raw<readonly Part[]>([]);
  private covered = $state(false);
  private readonly reading = new WeakMap<Element, ReturnType<typeof setTimeout>>();

  get read(): boolean {
    return !this.covered && this.parts.every((part) => part.seen) && this.parts.some((part) => part.here);
  }

  /** The parts that were never on the screen, from above. */
  get unread(): readonly Element[] {
    return this.parts.filter((part) => !part.seen).map(({ element }) => element).sort((a, b) => (FOLLOWS.has(a.compareDocumentPosition(b)) ? -1 : 1));
  }

  /** Something lies over the page from now on, or does not any more: what is behind it is read by nobody. */
  cover(so: boolean): void {
    this.covered = so;
    for (const { element, here } of this.parts) this.note(element, here);
  }

  /** Other words and values stand there from now on: what was read is to be read again. */
  anew(): void {
    for (const { element, here } of this.parts) {
      this.put(element, { seen: false });
      if (here) this.note(element, true);
    }
  }

  /** Watches one part; returns how to end that. */
  watch(element: Element): () => void {
    untrack(() => (this.parts = [...this.parts, { element, here: false, seen: false }])); // to watch is not to look
    const seen = new IntersectionObserver((entries) => {
      const entry = entries.at(-1);
      if (entry === undefined) return;
      const { boundingClientRect: whole, intersectionRect: shown } = entry;
      this.note(element, inSight(entry.isIntersecting, whole.height, shown.height, roomOf(element)));
    }, { threshold: SHARES });
    seen.observe(element);
    return () => {
      seen.disconnect();
      clearTimeout(this.reading.get(element));
      this.parts = this.parts.filter((part) => part.element !== element);
    };
  }

  /** Notes whether enough of a part is on the screen. */
  note(element: Element, here: boolean): void {
    clearTimeout(this.reading.get(element));
    if (here && !this.covered) this.reading.set(element, setTimeout(() => this.put(element, { seen: true }), READ_MS));
    this.put(element, { here });
  }

  private put(element: Element, change: Partial<Part>): void {
    this.parts = this.parts.map((part) => (part.element === element ? { ...part, ...change } : part));
  }
}
