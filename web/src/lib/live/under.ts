import type { Cell, Invocation } from '../api/documents';

type Runs = Pick<Invocation, 'id' | 'profile'> | null;

/** The profile whose limits and authority hold in a cell: what runs keeps the one it was launched under. */
export function profileIn(cell: Pick<Cell, 'busy' | 'profile'>, session: Runs): string {
  return session !== null && cell.busy === session.id ? session.profile : cell.profile;
}
