/** What could not be stored: it lasts as long as the page. */
const here = new Map<string, string>();

/** What this tab keeps over a reload. A browser that is told to store nothing, or has no room left, drives a robot all the same. */
export const tab = {
  read(key: string): string | null {
    try {
      return here.get(key) ?? sessionStorage.getItem(key);
    } catch {
      return null;
    }
  },

  write(key: string, value: string): void {
    tab.drop(key); // where there is no room, nothing older comes back either
    try {
      sessionStorage.setItem(key, value);
    } catch {
      here.set(key, value);
    }
  },

  drop(key: string): void {
    here.delete(key);
    try {
      sessionStorage.removeItem(key);
    } catch {
      // nothing is stored there
    }
  },
};
