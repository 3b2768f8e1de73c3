import { labelOf, withUnit } from '../format/quantity';
import { entryOf } from '../format/entry';

export interface ProfileFacts {
  sensitivity?: number;
  retry_budget?: number;
  limits?: Record<string, { max?: number; min?: number }>;
  authority?: { modes?: string[] };
  [key: string]: unknown;
}

export interface Difference {
  what: string;
  from: string;
  to: string;
  /** The new profile allows more, or watches less closely. */
  looser: boolean;
}

const LOOK: readonly string[] = ['tcp_speed_mps', 'base_speed_mps', 'grip_force_n', 'contact_force_n', 'payload_kg'];
const NAMES: Record<string, string> = { tcp_speed_mps: 'Tool speed', base_speed_mps: 'Base speed', contact_force_n: 'Contact force' };
const RANK: readonly string[] = ['nobody is asked', 'approval-on-escalation', 'approval-required'];

/** What changes from one profile to another, in words a person can weigh. */
export function differences(from: ProfileFacts | undefined, to: ProfileFacts | undefined): Difference[] {
  if (from === undefined || to === undefined) return [];
  return [...LOOK.flatMap((name) => ofLimit(name, from, to)), ...ofSensitivity(from, to), ...ofAsking(from, to)];
}

function ofLimit(name: string, from: ProfileFacts, to: ProfileFacts): Difference[] {
  const [a, b] = [from.limits?.[name]?.max, to.limits?.[name]?.max];
  if (a === undefined || b === undefined || a === b) return [];
  const text = (value: number): string => (name.endsWith('_kg') ? `${value} kg` : withUnit(name, value));
  return [{ what: `${entryOf(NAMES, name) ?? labelOf(name)}, at most`, from: text(a), to: text(b), looser: b > a }];
}

function ofSensitivity({ sensitivity: a }: ProfileFacts, { sensitivity: b }: ProfileFacts): Difference[] {
  if (a === undefined || b === undefined || a === b) return [];
  return [{ what: 'Watcher sensitivity', from: String(a), to: String(b), looser: b < a }];
}

function ofAsking(from: ProfileFacts, to: ProfileFacts): Difference[] {
  const [a, b] = [asking(from), asking(to)];
  return a === b ? [] : [{ what: 'Asking people', from: a, to: b, looser: RANK.indexOf(b) < RANK.indexOf(a) }];
}

function asking(facts: ProfileFacts): string {
  const modes = facts.authority?.modes ?? [];
  return RANK.findLast((mode) => modes.includes(mode)) ?? 'nobody is asked';
}
