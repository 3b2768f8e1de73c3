import { bar as standing } from './bar';

/** Whether the screen is a phone's, upright or held sideways: the stop then lies under the thumb. Styles ask the same. */
const query = matchMedia('(max-width: 760px), (max-height: 480px) and (max-width: 1100px)');

class Viewport {
  phone = $state(query.matches);

  constructor() {
    query.addEventListener('change', () => {
      this.phone = query.matches;
    });
  }
}

export const viewport = new Viewport();

/**
 * Keeps what stands at the lower edge of the screen there, and no larger, where fingers magnify the page, or a keyboard
 * lies over it: the stop would be out of sight. It goes by its lower right corner, which stays whatever comes into it.
 */
export function keptInSight(bar: HTMLElement): (() => void) | undefined {
  const seen = window.visualViewport;
  if (seen === null) return undefined;
  standing.on = bar;
  const gone = new AbortController();
  const stand = (): void => {
    const { offsetLeft, offsetTop, offsetWidth, offsetHeight } = bar; // where it would stand
    const right = offsetLeft + offsetWidth;
    const aside = seen.pageLeft + seen.width - right - (document.documentElement.clientWidth - right) / seen.scale;
    const below = seen.pageTop + seen.height - offsetTop - offsetHeight;
    bar.style.transform = seen.scale === 1 && below > -1 ? '' : `translate(${aside}px, ${below}px) scale(${1 / seen.scale})`;
  };
  seen.addEventListener('resize', stand, { signal: gone.signal });
  seen.addEventListener('scroll', stand, { signal: gone.signal });
  stand();
  return () => {
    gone.abort();
    standing.on = null;
  };
}
