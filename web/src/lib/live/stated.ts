import type { Escalation } from '../api/documents';
import { inBrief } from '../format/plain';

/** What an agent says its proposal is for, in its own words. */
export interface Stated {
  goal: string;
  task: string;
}

/** What is stated of a question, each empty where nothing is; null where nothing is stated at all. */
export function statedOf({ goal, task }: Escalation): Stated | null {
  const stated = { goal: inBrief(goal ?? ''), task: inBrief(task ?? '') };
  return stated.goal === '' && stated.task === '' ? null : stated;
}
