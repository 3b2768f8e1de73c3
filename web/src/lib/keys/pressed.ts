/** A click comes so soon after the finger that pressed or let go: that is no second press, though the first may be confirmed by then. */
const FINGER_MS = 1_000;

interface Handlers {
  onpointerdown: (event: PointerEvent) => void;
  onpointerup: (event: PointerEvent) => void;
  onclick: (event: MouseEvent) => void;
}

/**
 * How what restrains, a stop or a pause, is pressed: at once when a finger comes down, which it does not wait for to come up; by a key; and by what
 * presses without a finger. One press is one word, however it is heard.
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
  };
}
