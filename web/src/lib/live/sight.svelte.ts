import { untrack } from 'svelte';
import { Across, bringInto, common, heedScreen, isShown, magnifiedTo } from './magnified';

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

/** Of a length as it was worked out; of a word, as `auto`, none. */
const px = (length: string): number => Number.parseFloat(length) || 0;

/** How much of an element can be on the screen at once, px: what it is scrolled in is lower than that, by the bar with the stop and by what stays above. */
function roomOf(element: Element): number {
  let room = window.innerHeight;
  for (let around = element.parentElement; around !== null; around = around.parentElement) {
    const { overflowY, scrollPaddingTop, scrollPaddingBottom } = getComputedStyle(around);
    if (/auto|scroll/.test(overflowY)) room = Math.min(room, around.clientHeight - px(scrollPaddingTop) - px(scrollPaddingBottom));
  }
  return room;
}

/** Scrolls to a line, to its edges where there is no room around it: else a part of it would stay out of sight for good. */
function scrollTo(line: Element): void {
  const { scrollMarginTop, scrollMarginBottom } = getComputedStyle(line);
  const tight = line instanceof HTMLElement && line.offsetHeight + px(scrollMarginTop) + px(scrollMarginBottom) > roomOf(line);
  if (tight) line.style.scrollMargin = '0';
  line.scrollIntoView({ block: 'nearest' });
  if (tight) line.style.removeProperty('scroll-margin');
}

/** Whether what is asked could be read where it stands: all its parts were on the screen for a while, and one of them still is. */
export class Sight {
  private parts = $state.raw<readonly Part[]>([]);
  private covered = $state(false);
  private readonly reading = new WeakMap<Element, ReturnType<typeof setTimeout>>();
  /** Where the page is magnified, a line is read from side to side. */
  private across = new WeakMap<Element, Across>();
  private readonly all = new WeakMap<Element, () => boolean>();
  private looks: readonly (() => void)[] = [];

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
    for (const { element, here } of this.parts) this.note(element, here, this.all.get(element));
  }

  /** Other words and values stand there from now on: what was read is to be read again. */
  anew(): void {
    this.across = new WeakMap();
    for (const { element, here } of this.parts) {
      this.put(element, { seen: false });
      if (here) this.note(element, true, this.all.get(element));
    }
    this.looks.forEach((again) => again()); // other words move what stands below them
  }

  /** Watches one part; returns how to end that. */
  watch(element: Element): () => void {
    untrack(() => (this.parts = [...this.parts, { element, here: false, seen: false }])); // to watch is not to look
    const seen = new IntersectionObserver((entries) => {
      const entry = entries.at(-1);
      if (entry !== undefined) this.look(element, entry);
    }, { threshold: SHARES });
    seen.observe(element);
    // By itself it speaks of where the page is laid out: that is the same where fingers magnify it, or nobody sees it.
    const again = (): void => {
      seen.unobserve(element);
      seen.observe(element);
    };
    const deaf = heedScreen(again);
    this.looks = [...this.looks, again];
    return () => {
      deaf();
      this.looks = this.looks.filter((one) => one !== again);
      seen.disconnect();
      clearTimeout(this.reading.get(element));
      this.parts = this.parts.filter((part) => part.element !== element);
    };
  }

  private look(element: Element, { isIntersecting, boundingClientRect: whole, intersectionRect }: IntersectionObserverEntry): void {
    const screen = magnifiedTo();
    const shown = screen === null ? intersectionRect : common(intersectionRect, screen);
    const room = screen === null ? roomOf(element) : Math.min(roomOf(element), screen.bottom - screen.top);
    const here = isIntersecting && shown.right > shown.left && inSight(true, whole.height, shown.bottom - shown.top, room);
    const side = screen === null ? [0, whole.width] as const : [shown.left - whole.left, shown.right - whole.left] as const;
    this.note(element, here, () => this.readOf(element, whole.width, side));
  }

  /** Notes the stretch of a line that was read; returns whether that is all of it by now. */
  private readOf(element: Element, widthPx: number, side: readonly [number, number]): boolean {
    const across = Across.of(this.across.get(element), widthPx);
    this.across.set(element, across);
    across.read(...side);
    return across.endPx >= widthPx - ROUNDED_PX;
  }

  /** Leads to what was not read: all of it where it fits on the screen, or else its beginning; to a line whole behind the end of it. Returns whether there is any. */
  lead(): boolean {
    const room = magnifiedTo();
    const { unread } = this;
    const [first] = unread;
    if (room !== null && first !== undefined) bringInto(room, first, this.across.get(first)?.endPx ?? 0);
    else unread.toReversed().forEach(scrollTo);
    if (room !== null) this.looks.forEach((again) => again()); // it may stand there already, where something above it is gone
    return first !== undefined;
  }

  /** Notes whether enough of a part is on the screen; `all` says after a while whether it was read from side to side. */
  note(element: Element, here: boolean, all: () => boolean = () => true): void {
    clearTimeout(this.reading.get(element));
    this.all.set(element, all);
    if (here && !this.covered) this.reading.set(element, setTimeout(() => isShown() && all() && this.put(element, { seen: true }), READ_MS));
    this.put(element, { here });
  }

  private put(element: Element, change: Partial<Part>): void {
    this.parts = this.parts.map((part) => (part.element === element ? { ...part, ...change } : part));
  }
}
