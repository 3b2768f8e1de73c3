import { labelOf, withUnit } from '../format/quantity';

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
const ASKS = new Set(['approval-required', 'approval-on-escalation']);

/** What changes from one profile to another, in words a person can weigh. */
export function differences(from: ProfileFacts | undefined, to: ProfileFacts | undefined): Difference[] {
  if (from === undefined || to === undefined) return [];
  const found: Difference[] = [];
  for (const name of LOOK) {
    const [a, b] = [from.limits?.[name]?.max, to.limits?.[name]?.max];
    if (a === undefined || b === undefined || a === b) continue;
    const known = name.endsWith('_kg') ? [`${a} kg`, `${b} kg`] : [withUnit(name, a), withUnit(name, b)];
    found.push({ what: `${NAMES[name] ?? labelOf(name)}, at most`, from: known[0] ?? '', to: known[1] ?? '', looser: b > a });
  }
  if (from.sensitivity !== undefined && to.sensitivity !== undefined && from.sensitivity !== to.sensitivity) {
    found.push({ what: 'Watcher sensitivity', from: String(from.sensitivity), to: String(to.sensitivity), looser: to.sensitivity < from.sensitivity });
  }
  const [a, b] = [from, to].map((facts) => (facts.authority?.modes ?? []).filter((mode) => ASKS.has(mode)).join(', ') || 'nobody is asked');
  if (a !== undefined && b !== undefined && a !== b) {
    const rank = (text: string): number => (text.includes('approval-required') ? 2 : text.includes('approval-on') ? 1 : 0);
    found.push({ what: 'Asking people', from: a, to: b, looser: rank(b) < rank(a) });
  }
  return found;
}
