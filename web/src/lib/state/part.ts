/** Where a file of the console lies, in what browsers say when they could not fetch it. */
const ADDRESS = /https?:\/\/[^\s?]+\.js/;

/**
 * A part of the console that comes later than its first screen, and can be asked for again when it did not come.
 *
 * Browsers remember a module that they could not fetch, and fail at once whenever it is asked for (HTML standard, module
 * map; Chromium 150 does). So the second attempt asks for the same file under another address, which is another module.
 */
export class Part<T> {
  private address: string | null = null;
  private attempts = 0;

  constructor(
    private readonly load: () => Promise<T>,
    private readonly loadFrom: (address: string) => Promise<T> = (address) => import(/* @vite-ignore */ address) as Promise<T>,
  ) {}

  async fetch(): Promise<T> {
    try {
      if (this.address === null) return await this.load();
      this.attempts += 1;
      return await this.loadFrom(`${this.address}?${String(this.attempts)}`);
    } catch (error) {
      this.address = ADDRESS.exec(String(error))?.[0] ?? this.address; // whoever names none is asked as before
      throw error;
    }
  }
}
