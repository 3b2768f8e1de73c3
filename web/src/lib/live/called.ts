import type { Escalation } from '../api/documents';
import { loadOf, titleOf } from '../format/capability';
import { figuresOf } from '../format/quantity';
import type { Documents } from '../state/documents';

type Known = Pick<Documents, 'cells' | 'escalations'>;

/** What is asked, and where, if there are several cells. */
export function placedOf(asked: Pick<Escalation, 'capability' | 'effective' | 'cell' | 'carried'>, { cells }: Pick<Known, 'cells'>): string {
  const where = Object.keys(cells).length > 1 && asked.cell != null ? ` in ${asked.cell}` : '';
  return titleOf(asked.capability, asked.effective, loadOf(asked, cells)) + where;
}

/** Whether another one that waits reads the same. */
export function isAlike(asked: Escalation, known: Known): boolean {
  return Object.values(known.escalations).some((other) => other.id !== asked.id && placedOf(other, known) === placedOf(asked, known));
}

/** What a question is called where it does not stand before one, as in a notice; one that reads as another does also by who asks, and its figures. */
export function calledOf(asked: Escalation, known: Known): string {
  const apart = [asked.agent, figuresOf(asked.effective)].filter((part) => part !== '').join(', ');
  return placedOf(asked, known) + (isAlike(asked, known) ? ` (${apart})` : '');
}

/** What is said of something written that was not sent and goes with its page; nothing, where there is none. */
export function lostWords(what: string, of: readonly string[]): string[] {
  return of.length === 0 ? [] : [`Your ${what} ${of.join(', ')} was not sent, and is gone.`];
}
