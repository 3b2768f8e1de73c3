import type { Cell } from '../api/documents';

const FAR_M = 90; // there is nobody

/** How many people a cell sees, and how near: as Live says it where a session measures that, or else from the middle of its base. */
export function peopleWords({ facts, gauges }: Pick<Cell, 'facts' | 'gauges'>): string {
  const { people_count: count, people_nearest_m: nearestM } = facts ?? {};
  if (count === undefined) return 'not known';
  if (count === 0) return 'nobody seen';
  const { separation_m: separationM } = gauges;
  if (typeof separationM === 'number' && separationM < FAR_M) return `${count}, separation ${separationM.toFixed(2)} m`;
  return nearestM === undefined ? `${count}` : `${count}, nearest ${nearestM.toFixed(2)} m from the middle of the base`;
}
