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
