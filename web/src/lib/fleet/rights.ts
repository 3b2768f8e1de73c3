import type { Cell } from '../api/documents';

/** Why a control cannot be used; null where it can. */
export type Barrier = string | null;

interface Situation {
  role: string | null;
  live: boolean;
  cell: Cell;
}

/** Who may put a cell under another profile. Whatever is shown, the server decides. */
export function profileBarrier({ role, live }: Omit<Situation, 'cell'>): Barrier {
  if (!live) return 'The link is down: nothing but a stop is sent.';
  if (role !== 'operator' && role !== 'engineer') return 'Operators and engineers change the profile; you may look.';
  return null;
}

/** Who may lead a cell out of its latched stop. */
export function resetBarrier({ role, live, cell }: Situation): Barrier {
  if (!cell.latched) return 'Nothing is latched.';
  if (!live) return 'The link is down: nothing but a stop is sent.';
  if (role !== 'operator') return 'Operators reset a stop; you may look.';
  return null;
}

/** How well the server hears a cell, in words. */
export function heard(cell: Cell): { text: string; tone: 'ok' | 'danger' | 'warn' } {
  if (!cell.online) return { text: 'Not heard', tone: 'danger' };
  if (cell.holding_link) return { text: 'Lease lapsed, holding', tone: 'warn' };
  return { text: 'Heard', tone: 'ok' };
}

/** Whether a cell runs on the policy that is in force; null where it has not said. */
export function samePolicy(cell: Cell, version: string | null): boolean | null {
  return cell.policy_version === null || version === null ? null : cell.policy_version === version;
}
