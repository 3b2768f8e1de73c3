import type { Attachment } from 'svelte/attachments';
import { track } from '../state/track';
import { keyOf, pointerOf, presses, type Presses } from './presses';

/** So long a control has to stand there, under no press, before it takes one: the last press was meant for another. */
export const ARM_MS = 700;

/**
 * Whether a control, or a group of them, takes a press.
 *
 * After a press another control may stand under the same finger: the second tap of a double one is no answer to it.
 * What has just come waits until it is in sight or has the focus, until what was held when it came has been let go, and for `ARM_MS`
 * from then; a press that it did not take begins that anew. Never for what stops or pauses: that counts at once.
 */
export class Arming {
  ready = $state(false);
  private inSight = false;
  /** What is held and was not meant for this: it has to be let go first. */
  private awaited: readonly string[] = [];
  private timer: ReturnType<typeof setTimeout> | undefined;
  private on: HTMLElement | null = null;

  constructor(private readonly pressed: Pick<Presses, 'now'> = presses) {}

  /** It came now, or means something else from now on. */
  begin(): void {
    this.ready = false;
    this.awaited = [...this.pressed.now];
    this.count();
  }

  end(): void {
    clearTimeout(this.timer);
    this.ready = this.inSight = false;
  }

  sight(so: boolean): void {
    this.inSight = so;
    if (!this.ready) this.count();
  }

  /** Takes a press of the control; returns whether it counts. */
  press(what: string): boolean {
    if (this.ready) return true;
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
   * (`aria-disabled`) has to heed `ready` there. Begins anew with whatever the control is `about`.
   */
  over(about: unknown = null): Attachment<HTMLElement> {
    track(about);
    return (element) => {
      this.on = element;
      this.begin();
      const end = this.listen(element);
      const says = !element.hasAttribute('aria-disabled');
      $effect(() => {
        element.toggleAttribute('data-arming', !this.ready);
        if (says && !this.ready) element.setAttribute('aria-disabled', 'true');
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
      if (what === null ? this.ready : this.press(what)) return;
      event.stopImmediatePropagation();
      if (event.type !== 'pointerdown') event.preventDefault(); // a finger may still scroll
    };
    element.addEventListener('click', (event) => refuse(event, null), how);
    element.addEventListener('pointerdown', (event) => refuse(event, pointerOf(event)), how);
    element.addEventListener('keydown', (event) => (event.key === 'Enter' || event.key === ' ') && refuse(event, keyOf(event)), how);
    // By keyboard, or by ear, one may be at it where it is out of sight.
    const attended = (): boolean => element.contains(document.activeElement);
    element.addEventListener('focusin', () => this.inSight || this.sight(true), how);
    const seen = new IntersectionObserver((entries) => this.sight(entries.at(-1)?.isIntersecting === true || attended()));
    seen.observe(element);
    const deaf = presses.onUp((what) => this.letGo(what));
    return () => {
      end.abort();
      seen.disconnect();
      deaf();
    };
  }
}

/** Over a control, or a group of them, that nobody needs to ask whether it is ready. */
export function armed(about: unknown = null): Attachment<HTMLElement> {
  return new Arming().over(about);
}
