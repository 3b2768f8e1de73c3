import { bar } from '../state/bar';

/** Where something is drawn, px from the upper left corner of the page as it is laid out. */
export interface Box {
  left: number;
  top: number;
  right: number;
  bottom: number;
}

/** What the screen shows of the page: less than all where fingers magnify it, or a keyboard lies over it. */
export type Shows = Pick<VisualViewport, 'offsetLeft' | 'offsetTop' | 'width' | 'height' | 'scale'>;

const MAGNIFIED = 1.01;
/** Where something ends between two pixels. */
const ROUNDED_PX = 1;
/** Scrolling ends between two pixels, too. */
const SPARE_PX = 4;

/** What the bar with the stop leaves of the screen: it lies over the page where that is magnified, at its lower edge or, held sideways, on the right. */
export function roomOn({ offsetLeft, offsetTop, width, height }: Shows, bar: Box | null): Box {
  const screen = { left: offsetLeft, top: offsetTop, right: offsetLeft + width, bottom: offsetTop + height };
  if (bar === null) return screen;
  const aside = bar.left > screen.left + width / 2;
  return aside ? { ...screen, right: Math.min(screen.right, bar.left) } : { ...screen, bottom: Math.min(screen.bottom, bar.top) };
}

/** What two boxes have in common; as high or wide as nothing where that is nothing. */
export function common(one: Box, other: Box): Box {
  const [left, top] = [Math.max(one.left, other.left), Math.max(one.top, other.top)];
  return { left, top, right: Math.max(left, Math.min(one.right, other.right)), bottom: Math.max(top, Math.min(one.bottom, other.bottom)) };
}

/** How far a line was read from side to side, px from its left edge, stretch by stretch; of one that fits on the screen, at once. */
export class Across {
  private stretches: readonly (readonly [number, number])[] = [];

  constructor(private readonly widthPx: number) {}

  /** Goes on with what was read of a line, unless that is laid out anew since: then it is elsewhere. */
  static of(before: Across | undefined, widthPx: number): Across {
    return before?.widthPx === widthPx ? before : new Across(widthPx);
  }

  read(fromPx: number, toPx: number): void {
    if (toPx > fromPx) this.stretches = [...this.stretches, [fromPx, toPx] as const].sort(([a], [b]) => a - b);
  }

  /** Where what was read from the left edge on ends, px. */
  get endPx(): number {
    return this.stretches.reduce((end, [from, to]) => (from <= end + ROUNDED_PX ? Math.max(end, to) : end), 0);
  }
}

/** What the screen has room for; null where it shows the page as it is laid out. */
export function magnifiedTo(): Box | null {
  const shows = globalThis.visualViewport ?? null;
  if (shows === null || (shows.scale <= MAGNIFIED && shows.height >= window.innerHeight - ROUNDED_PX)) return null;
  return roomOn(shows, bar.box);
}

/** Brings a line into such a room from where it was read on, as much of it as fits: what is wider would be scrolled to neither of its ends. */
export function bringInto(room: Box, line: Element, fromPx: number): void {
  const page = line.closest('main');
  if (page === null) return;
  const [its, around] = [line.getBoundingClientRect(), page.getBoundingClientRect()];
  const [wide, high] = [Math.min(room.right - room.left, around.width), Math.min(room.bottom - room.top, around.height)];
  const [width, height] = [Math.min(its.width - fromPx, wide - 2 * SPARE_PX), Math.min(its.height, high)];
  const spare = Math.min(SPARE_PX, (high - height) / 2);
  const { offsetLeft, offsetTop, width: shownPx, height: lowPx } = window.visualViewport ?? { offsetLeft: 0, offsetTop: 0, width: wide, height: high };
  // What the bar lies over is no room; where the page ends above it anyway, nothing is. To the side the screen moves alone, and the page does not scroll.
  const [aside, below] = [offsetLeft + shownPx - room.right, Math.min(offsetTop + lowPx, around.bottom) - room.bottom];
  const part = document.createElement('i');
  const px = (value: number): string => `${value}px`;
  Object.assign(part.style, {
    position: 'absolute',
    left: px(its.left + fromPx - around.left + page.scrollLeft),
    top: px(its.top - around.top + page.scrollTop),
    width: px(width),
    height: px(height),
    scrollMargin: `${px(spare)} ${px(Math.max(0, aside) + SPARE_PX)} ${px(Math.max(0, below) + spare)} ${px(SPARE_PX)}`,
  });
  page.append(part);
  part.scrollIntoView({ block: 'nearest', inline: 'nearest' });
  part.remove();
}

/**
 * Calls back whenever the screen may show something else of the page than before, or none of it: where the page is magnified,
 * the screen is moved over it, and what scrolls in it moves under the screen.
 */
export function heedScreen(changed: () => void): () => void {
  if (typeof document === 'undefined') return () => undefined;
  const gone = new AbortController();
  for (const change of ['resize', 'scroll']) window.visualViewport?.addEventListener(change, changed, { signal: gone.signal });
  document.addEventListener('visibilitychange', changed, { signal: gone.signal });
  document.addEventListener('scroll', () => magnifiedTo() !== null && changed(), { capture: true, signal: gone.signal });
  return () => gone.abort();
}

/** Whether the page is shown at all: its tab may lie behind another one, and a phone in a pocket. */
export function isShown(): boolean {
  return typeof document === 'undefined' || document.visibilityState !== 'hidden';
}
