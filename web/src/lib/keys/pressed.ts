/** A click comes so soon after the finger that pressed or let go: that is no second press, though the first may be confirmed by then. */
const FINGER_MS = 1_000;

interface Handlers {
  onpointerdown: (event: PointerEvent) => void;
  onpointerup: (event: PointerEvent) => void;
  onclick: (event: MouseEvent) => void;
  onkeydown: (event: KeyboardEvent) => void;
}

/**
 * How what restrains, a stop or a pause, is pressed: at once when a finger or a key comes down, which it does not wait for to come up; and by what
 * presses without either. One press is one word, however it is heard.
 */
export function atOnce(press: () => void): Handlers {
  let fingerMs = -Infinity;
  return {
    onpointerdown({ timeStamp }) {
      fingerMs = timeStamp;
      press();
    },
    // Whoever means it may lean on it for seconds.
    onpointerup({ timeStamp }) {
      fingerMs = timeStamp;
    },
    onclick({ detail, timeStamp }) {
      if (detail === 0 || timeStamp - fingerMs > FINGER_MS) press();
    },
    // A browser clicks for Space as that is let go, and once more for each time that Enter repeats.
    onkeydown(event) {
      if (event.key !== ' ' && event.key !== 'Enter') return;
      event.preventDefault();
      if (!event.repeat) press();
    },
  };
}
