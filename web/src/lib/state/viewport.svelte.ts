/** Whether the screen is a phone's: the stop then lies under the thumb. */
const query = matchMedia('(max-width: 760px)');

class Viewport {
  narrow = $state(query.matches);

  constructor() {
    query.addEventListener('change', () => {
      this.narrow = query.matches;
    });
  }
}

export const viewport = new Viewport();
