/** The bar with the stop, where it stands at the lower edge of the screen, or beside it. */
export const bar = {
  on: null as HTMLElement | null,
  get box(): DOMRect | null {
    return this.on?.getBoundingClientRect() ?? null;
  },
};
