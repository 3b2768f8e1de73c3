/** The finger that pressed comes up soon; that is no second press, though the first may be confirmed by then. */
const FINGER_MS = 1_000;

/**
 * How a stop is pressed: at once when a finger comes down, which it does not wait for to come up; by a key; and by what
 * presses without a finger. One press is one stop, however it is heard.
 */
export function atOnce(press: () => void): { onpointerdown: (event: PointerEvent) => void; onclick: (event: MouseEvent) => void } {
  let downMs = -Infinity;
  return {
    onpointerdown({ timeStamp }) {
      downMs = timeStamp;
      press();
    },
    onclick({ detail, timeStamp }) {
      if (detail === 0 || timeStamp - downMs > FINGER_MS) press();
    },
  };
}
