/** Where a control stands on the screen, px: its edges, and how far what it stands in has been scrolled. */
export interface Standing {
  left: number;
  top: number;
  right: number;
  bottom: number;
  scrolledX: number;
  scrolledY: number;
}

/** A control that moves by less is still under the same finger, px. */
const UNMOVED_PX = 8;

export function standingOf(element: HTMLElement): Standing {
  const { left, top, right, bottom } = element.getBoundingClientRect();
  let [scrolledX, scrolledY] = [0, 0];
  for (let around = element.parentElement; around !== null; around = around.parentElement) {
    scrolledX += around.scrollLeft;
    scrolledY += around.scrollTop;
  }
  return { left, top, right, bottom, scrolledX, scrolledY };
}

const far = (...by: number[]): boolean => by.some((px) => Math.abs(px) > UNMOVED_PX);

/** Says whether something else moved a control; whoever scrolls moves it themselves. */
export function wasMoved(before: Standing, now: Standing): boolean {
  const [left, top, right, bottom] = [now.left - before.left, now.top - before.top, now.right - before.right, now.bottom - before.bottom];
  const [x, y] = [now.scrolledX - before.scrolledX, now.scrolledY - before.scrolledY];
  return far(left, top, right, bottom) && far(left + x, top + y, right + x, bottom + y);
}

/** Says whether it is still where it was, scrolled or not. */
export function stayed(before: Standing, now: Standing): boolean {
  return !far(now.left - before.left, now.top - before.top, now.right - before.right, now.bottom - before.bottom, now.scrolledX - before.scrolledX, now.scrolledY - before.scrolledY);
}
