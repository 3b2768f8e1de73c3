import type { Risk } from '../api/documents';
import { entryOf } from '../format/entry';
import { labelOf, withUnit } from '../format/quantity';
import { nearDifferences, watchDifferences, type Watching } from './watched';
import { FEWER, MORE, ofNumbers, type Difference, type Way } from './ways';

export interface ProfileFacts {
  sensitivity?: number;
  retry_budget?: number;
  /** Whether people and robot are on one floor: rules may go by it. */
  shared_floor?: boolean;
  rollback?: string;
  modes?: string[];
  limits?: Record<string, { max?: number; min?: number }>;
  authority?: { modes?: string[]; approval?: { risk: string[]; approvers?: Record<string, number> } | null; review?: { risk: string[]; outcomes: string[] } | null };
  [key: string]: unknown;
}

const LOOK: readonly string[] = ['tcp_speed_mps', 'base_speed_mps', 'grip_force_n', 'contact_force_n', 'payload_kg'];
const NAMES: Record<string, string> = { tcp_speed_mps: 'Tool speed', base_speed_mps: 'Base speed', contact_force_n: 'Contact force' };
const RANK: readonly string[] = ['nobody is asked', 'approval-on-escalation', 'approval-required'];
/** Modes of authority besides asking: what they let people do, and what it is to lose one, and to gain one. */
const MODES: readonly { mode: string; what: string; lost: Way; gained: Way }[] = [
  { mode: 'takeover-enabled', what: 'Taking the controls', lost: 'different', gained: 'different' },
  { mode: 'interrupt-enabled', what: 'Pausing what runs', lost: 'looser', gained: 'stricter' },
];

/** What changes from one profile to another, in words a person can weigh; of what each watches only where that is known. */
export function differences(from: ProfileFacts | undefined, to: ProfileFacts | undefined, watching?: readonly [Watching, Watching]): Difference[] {
  if (from === undefined || to === undefined) return [];
  return [
    ...(watching === undefined ? [] : nearDifferences(...watching)),
    ...ofAsking(from, to),
    ...ofApprovers(from, to),
    ...ofModes(from, to),
    ...ofFloor(from, to),
    ...LOOK.flatMap((name) => ofLimit(name, from, to)),
    ...ofNumber('Retries, at most', from.retry_budget, to.retry_budget, MORE),
    ...ofUndoing(from, to),
    ...ofAdmitted(from, to),
    ...ofNumber('Watcher sensitivity', from.sensitivity, to.sensitivity, FEWER),
    ...(watching === undefined ? [] : watchDifferences(...watching)),
    ...ofReview(from, to),
  ];
}

function ofLimit(name: string, from: ProfileFacts, to: ProfileFacts): Difference[] {
  const text = (value: number): string => (name.endsWith('_kg') ? `${value} kg` : withUnit(name, value));
  return ofNumber(`${entryOf(NAMES, name) ?? labelOf(name)}, at most`, from.limits?.[name]?.max, to.limits?.[name]?.max, MORE, text);
}

function ofNumber(what: string, a: number | undefined, b: number | undefined, way: typeof MORE, text: (value: number) => string = String): Difference[] {
  return a === undefined || b === undefined || a === b ? [] : [{ what, from: text(a), to: text(b), way: way(a, b) }];
}

function ofAsking(from: ProfileFacts, to: ProfileFacts): Difference[] {
  const [a, b] = [askingOf(from), askingOf(to)];
  const way = RANK.indexOf(b.mode) < RANK.indexOf(a.mode) || (a.mode === b.mode && lacks(b.risk, a.risk)) ? 'looser' : 'stricter';
  return a.text === b.text ? [] : [{ what: 'Asking people', from: a.text, to: b.text, way }];
}

const RISKS: readonly Risk[] = ['low', 'medium', 'high', 'critical'];

/** How many different people it takes, by risk, where both ask people at all. */
function ofApprovers(from: ProfileFacts, to: ProfileFacts): Difference[] {
  if ([from, to].some((facts) => !askingOf(facts).mode.startsWith('approval'))) return [];
  const of = ({ authority }: ProfileFacts): Record<string, number> => {
    const { approvers = {} } = authority?.approval ?? {};
    return Object.fromEntries(RISKS.map((risk) => [risk, entryOf(approvers, risk) ?? approvers['default'] ?? 1]));
  };
  return ofNumbers('People who have to approve', of(from), of(to), FEWER, (risk, people) => `${people} for ${risk} risk`);
}

/** Only where approval is required does a risk alone have people asked. */
export function askingOf(facts: ProfileFacts | undefined): { mode: string; risk: string[]; text: string } {
  const authority = facts?.authority;
  const modes = authority?.modes ?? [];
  const mode = RANK.findLast((one) => modes.includes(one)) ?? 'nobody is asked';
  const risk = mode === 'approval-required' ? (authority?.approval?.risk ?? []) : [];
  return { mode, risk, text: risk.length === 0 ? mode : `${mode}: ${risk.join(', ')} risk` };
}

function ofModes(from: ProfileFacts, to: ProfileFacts): Difference[] {
  const has = (facts: ProfileFacts, mode: string): boolean => facts.authority?.modes?.includes(mode) === true;
  const text = (allowed: boolean): string => (allowed ? 'people may' : 'nobody may');
  return MODES.flatMap(({ mode, what, lost, gained }) => {
    const [a, b] = [has(from, mode), has(to, mode)];
    return a === b ? [] : [{ what, from: text(a), to: text(b), way: a ? lost : gained }];
  });
}

/** Of what is undone behind a failure, from the least to the most; `required` is of what grasps and moves things. */
const UNDOES: readonly string[] = ['optional', 'required', 'always'];

function ofUndoing({ rollback: a }: ProfileFacts, { rollback: b }: ProfileFacts): Difference[] {
  if (a === undefined || b === undefined || a === b) return [];
  return [{ what: 'Undoing what failed', from: a, to: b, way: UNDOES.indexOf(b) < UNDOES.indexOf(a) ? 'looser' : 'stricter' }];
}

function ofFloor({ shared_floor: a }: ProfileFacts, { shared_floor: b }: ProfileFacts): Difference[] {
  const text = (shared: boolean): string => (shared ? 'shared with people' : 'not shared');
  return a === undefined || b === undefined || a === b ? [] : [{ what: 'Floor', from: text(a), to: text(b), way: a ? 'looser' : 'stricter' }];
}

function ofAdmitted({ modes: a = [] }: ProfileFacts, { modes: b = [] }: ProfileFacts): Difference[] {
  const text = (modes: readonly string[]): string => [...modes].sort().join(', ');
  return text(a) === text(b) ? [] : [{ what: 'Modes that agents may choose', from: text(a), to: text(b), way: lacks(a, b) ? 'looser' : 'stricter' }];
}

function ofReview(from: ProfileFacts, to: ProfileFacts): Difference[] {
  const [a, b] = [from.authority?.review ?? null, to.authority?.review ?? null];
  const text = (review: typeof a): string => (review === null ? 'nothing waits for a verdict' : `${review.risk.join(', ')} risk: ${review.outcomes.map((one) => one.replaceAll('_', ' ')).join(', ')}`);
  const less = a !== null && (b === null || lacks(b.risk, a.risk) || lacks(b.outcomes, a.outcomes));
  return text(a) === text(b) ? [] : [{ what: 'Review of what is over', from: text(a), to: text(b), way: less ? 'looser' : 'stricter' }];
}

function lacks(those: readonly string[], these: readonly string[]): boolean {
  return these.some((one) => !those.includes(one));
}
