/** What the person at this browser prefers; kept between shifts. */
type Theme = 'dark' | 'light';

function read(key: string): string | null {
  try {
    return localStorage.getItem(key);
  } catch {
    return null; // storage may be forbidden: preferences then last as long as the page
  }
}

function write(key: string, value: string): void {
  try {
    localStorage.setItem(key, value);
  } catch {
    // the same: nothing depends on it
  }
}

class Settings {
  theme = $state<Theme>(initialTheme());
  sound = $state(read('reins.sound') !== 'off');
  /** Whether single letters, digits and signs are shortcuts. */
  singleKeys = $state(read('reins.keys') !== 'off');

  toggleTheme(): void {
    this.theme = this.theme === 'dark' ? 'light' : 'dark';
    write('reins.theme', this.theme);
  }

  toggleSound(): void {
    this.sound = !this.sound;
    write('reins.sound', this.sound ? 'on' : 'off');
  }

  toggleSingleKeys(): void {
    this.singleKeys = !this.singleKeys;
    write('reins.keys', this.singleKeys ? 'on' : 'off');
  }
}

function initialTheme(): Theme {
  const kept = read('reins.theme');
  if (kept === 'dark' || kept === 'light') return kept;
  return matchMedia('(prefers-color-scheme: light)').matches ? 'light' : 'dark';
}

export const settings = new Settings();
