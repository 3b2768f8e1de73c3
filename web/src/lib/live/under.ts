import type { Cell, Invocation } from '../api/documents';

type Runs = Pick<Invocation, 'id' | 'profile'> | null;

/** The profile whose limits and authority hold in a cell: what runs keeps the one it was launched under. */
export function profileIn(cell: Pick<Cell, 'busy' | 'profile'>, session: Runs): string {
  return session !== null && cell.busy === session.id ? session.profile : cell.profile;
}

/** Says that what runs is not under the profile that its cell has by now; empty where it is. */
export function keptWords(cell: Pick<Cell, 'busy' | 'profile'>, session: Runs): string {
  const kept = profileIn(cell, session);
  return kept === cell.profile ? '' : `Launched under ${kept}, it keeps that: ${cell.profile} holds for what comes next.`;
}
