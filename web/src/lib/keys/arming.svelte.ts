import type { Attachment } from 'svelte/attachments';
import { track } from '../state/track';
import { standingOf, stayed, wasMoved, type Standing } from './standing';
import { keyOf, pointerOf, presses, type Presses } from './presses';

/** So long a control has to stand there, under no press, before it takes one: the last press was meant for another. */
export const ARM_MS = 700;
/** How often one looks whether it still stands where it stood. */
const LOOK_MS = 100;

/**
 * Whether a control, or a group of them, takes a press.
 *
 * After a press another control may stand under the same finger: the second tap of a double one is no answer to it.
 * What has just come waits until it is in sight or has the focus, until what was held when it came has been let go, and for `ARM_MS`
 * from then; a press that it did not take begins that anew. Never for what stops or pauses: that counts at once.
 *
 * What the page moves comes under a finger as well, and another control to where it was: no finger counts on it for as
 * long. A key is pressed wherever it stands.
 */
export class Arming {
  ready = $state(false);
  /** Whether the page moved it a moment ago: then a key counts, and no finger. */
  moved = $state(false);
  private inSight = false;
  private stands: Standing | null = null;
  private settling: ReturnType<typeof setTimeout> | undefined;
  /** What is held and was not meant for this: it has to be let go first. */
  private awaited: readonly string[] = [];
  private timer: ReturnType<typeof setTimeout> | undefined;
  private on: HTMLElement | null = null;

  constructor(private readonly pressed: Pick<Presses, 'now'> = presses) {}

  /** It came now, or means something else from now on. */
  begin(): void {
    this.ready = false;
    this.awaited = [...this.pressed.now];
    this.stands = null;
    this.count();
  }

  end(): void {
    clearTimeout(this.timer);
    clearTimeout(this.settling);
    this.ready = this.inSight = this.moved = false;
  }

  sight(so: boolean): void {
    this.inSight = so;
    if (!this.ready) this.count();
  }

  /** Takes note of where it stands now. */
  stood(now: Standing): void {
    const before = this.stands;
    if (before !== null && wasMoved(before, now)) {
      clearTimeout(this.settling);
      this.moved = true;
      this.settling = setTimeout(() => (this.moved = false), ARM_MS);
    }
    if (before === null || !stayed(before, now)) this.stands = now;
  }

  /** Takes a press of the control, by a finger where it stood; returns whether it counts. */
  press(what: string, finger = false): boolean {
    if (this.ready && !(finger && this.moved)) return true;
    this.ready = false;
    this.awaited = [...this.awaited, what];
    this.count();
    return false;
  }

  letGo(what: string): void {
    if (!this.awaited.includes(what)) return;
    this.awaited = this.awaited.filter((known) => known !== what);
    this.count();
  }

  /**
   * Watches over an element, and says of it that it takes no press yet; one that says itself whether it is disabled
   * (`aria-disabled`) has to heed `ready` and `moved` there. Begins anew with whatever the control is `about`.
   */
  over(about: unknown = null): Attachment<HTMLElement> {
    track(about);
    return (element) => {
      this.on = element;
      this.begin();
      const end = this.listen(element);
      const says = !element.hasAttribute('aria-disabled');
      $effect(() => {
        const waits = !this.ready || this.moved;
        element.toggleAttribute('data-arming', waits);
        if (says && waits) element.setAttribute('aria-disabled', 'true');
        return () => {
          element.removeAttribute('data-arming');
          if (says) element.removeAttribute('aria-disabled');
        };
      });
      return () => {
        end();
        if (this.on === element) this.end(); // another may have taken its place by now
      };
    };
  }

  private count(): void {
    clearTimeout(this.timer);
    if (this.inSight && this.awaited.length === 0) this.timer = setTimeout(() => (this.ready = true), ARM_MS);
  }

  private listen(element: HTMLElement): () => void {
    const end = new AbortController();
    const how = { capture: true, signal: end.signal };
    const refuse = (event: Event, what: string | null): void => {
      const finger = event.type === 'pointerdown';
      if (finger) this.stood(standingOf(element));
      if (what === null ? this.ready : this.press(what, finger)) return;
      event.stopImmediatePropagation();
      if (event.type !== 'pointerdown') event.preventDefault(); // a finger may still scroll
    };
    element.addEventListener('click', (event) => refuse(event, null), how);
    element.addEventListener('pointerdown', (event) => refuse(event, pointerOf(event)), how);
    // What does not take the press does not take the focus either: Enter may follow.
    element.addEventListener('mousedown', (event) => !this.ready && event.preventDefault(), how);
    element.addEventListener('keydown', (event) => (event.key === 'Enter' || event.key === ' ') && refuse(event, keyOf(event)), how);
    // By keyboard, or by ear, one may be at it where it is out of sight.
    const attended = (): boolean => element.contains(document.activeElement);
    element.addEventListener('focusin', () => this.inSight || this.sight(true), how);
    const seen = new IntersectionObserver((entries) => this.sight(entries.at(-1)?.isIntersecting === true || attended()));
    seen.observe(element);
    const standing = setInterval(() => this.stood(standingOf(element)), LOOK_MS);
    const deaf = presses.onUp((what) => this.letGo(what));
    return () => {
      end.abort();
      clearInterval(standing);
      seen.disconnect();
      deaf();
    };
  }
}

/** Over a control, or a group of them, that nobody needs to ask whether it is ready. */
export function armed(about: unknown = null): Attachment<HTMLElement> {
  return new Arming().over(about);
}
