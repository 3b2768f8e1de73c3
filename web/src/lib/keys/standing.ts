/** Where a control stands on the screen, px: its edges, how far what it stands in has been scrolled, and how high all that is. */
export interface Standing {
  left: number;
  top: number;
  right: number;
  bottom: number;
  scrolledX: number;
  scrolledY: number;
  heights: number;
}

/** A control that moves by less is still under the same finger, px. */
const UNMOVED_PX = 8;

export function standingOf(element: HTMLElement): Standing {
  const { left, top, right, bottom } = element.getBoundingClientRect();
  let [scrolledX, scrolledY, heights] = [0, 0, 0];
  for (let around = element.parentElement; around !== null; around = around.parentElement) {
    scrolledX += around.scrollLeft;
    scrolledY += around.scrollTop;
    heights += around.scrollHeight + around.clientHeight;
  }
  return { left, top, right, bottom, scrolledX, scrolledY, heights };
}

const far = (...by: number[]): boolean => by.some((px) => Math.abs(px) > UNMOVED_PX);

/**
 * Says whether something else moved a control. Whoever scrolls moves it themselves; what is scrolled as something grows or
 * goes, by the page or for want of anything to show, nobody scrolled.
 */
export function wasMoved(before: Standing, now: Standing): boolean {
  const [left, top, right, bottom] = [now.left - before.left, now.top - before.top, now.right - before.right, now.bottom - before.bottom];
  const [x, y] = [now.scrolledX - before.scrolledX, now.scrolledY - before.scrolledY];
  const own = now.heights === before.heights && !far(left + x, top + y, right + x, bottom + y);
  return far(left, top, right, bottom) && !own;
}

/** Says whether it is still where it was, scrolled or not. */
export function stayed(before: Standing, now: Standing): boolean {
  return !far(now.left - before.left, now.top - before.top, now.right - before.right, now.bottom - before.bottom, now.scrolledX - before.scrolledX, now.scrolledY - before.scrolledY);
}
