import type { Capability, Confirming, InputSchema, PolicySet } from '../api/documents';
import { entryOf } from '../format/entry';
import { labelFor, labelOf, unitOf } from '../format/quantity';

/** A rule as `/v1/policies/active` describes it. */
export interface Rule {
  id: string;
  applies_to: string[] | null;
  profiles: string[] | null;
  when: string | null;
  then: 'allow' | 'modify' | 'escalate' | 'deny';
  set: Record<string, { min?: number; max?: number; to?: string | number }>;
  /** How many people a rule that asks wants; null or absent where it leaves that to the profile. */
  approvers?: number | null;
  because: string;
  remedy: string;
}

interface ProfilePolicy {
  limits?: Record<string, { max?: number; unit?: string; source?: string }>;
  watch?: string[];
  authority?: {
    modes?: string[];
    approval?: { risk: string[]; within_s: number; on_timeout: string; approvers: Record<string, number> } | null;
  };
  [key: string]: unknown;
}

export type Standing = 'forbidden' | 'asks' | 'bounded' | 'allowed';

/** What a parameter may be, and what says so. */
export interface Bound {
  param: string;
  label: string;
  unit: string;
  min: number | null;
  max: number | null;
  minBy: string;
  maxBy: string;
  /** Tighter than the capability's own schema. */
  tightened: boolean;
}

export interface Square {
  capability: string;
  profile: string;
  /** The manifest's word for this profile, as written. */
  marked: string;
  standing: Standing;
  bounds: Bound[];
  asks: { people: number; withinS: number; onTimeout: string } | null;
  /** What waits for a person in mid-execution, in the order policy lists it. */
  confirms: Confirming[];
  /** Escalations end in a denial: nobody could answer them here. */
  nobodyAnswers: boolean;
  always: Rule[];
  sometimes: Rule[];
}

export const STANDINGS: Record<Standing, string> = {
  forbidden: 'Forbidden',
  asks: 'Asks a person',
  bounded: 'Within bounds',
  allowed: 'Allowed',
};

/** Modes of authority under which people are asked before something is launched. */
const ASKING: ReadonlySet<string> = new Set(['approval-required', 'approval-on-escalation']);

/** Rules that may determine a proposal of this capability under this profile. */
export function rulesFor(policy: PolicySet, capability: string, profile: string): Rule[] {
  return (policy.rules as unknown as Rule[]).filter(
    (rule) => (rule.applies_to?.includes(capability) ?? true) && (rule.profiles?.includes(profile) ?? true),
  );
}

/**
 * What is known of a square before anything is proposed: the tightest of schema, profile limit and unconditional rule
 * for each parameter, and whether a person is asked. What depends on the proposal stands in `sometimes`; only
 * `/v1/check` knows how that falls.
 */
export function squareOf(policy: PolicySet, capability: Capability, profile: string): Square {
  const facts = (policy.profiles[profile] ?? {}) as ProfilePolicy;
  const marked = capability.env_profile?.[profile] ?? 'forbidden';
  const rules = rulesFor(policy, capability.name, profile);
  const always = rules.filter((rule) => rule.when === null);
  const bounds = Object.entries(capability.inputs.properties ?? {})
    .filter(([, schema]) => schema.type === 'number' || schema.type === 'integer')
    .map(([param, schema]) => boundOf(param, schema, facts, always));
  const asks = asked(capability, facts, marked);
  const modes = facts.authority?.modes ?? [];
  return {
    capability: capability.name,
    profile,
    marked,
    standing: standingOf(marked, asks !== null, always, bounds),
    bounds,
    asks,
    confirms: (policy.authority?.confirm_before ?? []).filter((entry) => entry.capability === capability.name && entry.profile === profile),
    nobodyAnswers: !modes.some((mode) => ASKING.has(mode)),
    always,
    sometimes: rules.filter((rule) => rule.when !== null),
  };
}

function standingOf(marked: string, asks: boolean, always: readonly Rule[], bounds: readonly Bound[]): Standing {
  if (marked === 'forbidden' || always.some((rule) => rule.then === 'deny')) return 'forbidden';
  if (asks || always.some((rule) => rule.then === 'escalate')) return 'asks';
  return bounds.some((bound) => bound.tightened) ? 'bounded' : 'allowed';
}

function boundOf(param: string, schema: InputSchema, facts: ProfilePolicy, always: readonly Rule[]): Bound {
  const own = { by: 'the capability’s own schema', min: schema.minimum, max: schema.maximum };
  const said = [own, ...limitOf(schema, facts), ...always.map(({ id, set }) => ({ by: id, min: set[param]?.min, max: set[param]?.max }))];
  const least = tightest(said.map(({ by, min }) => ({ by, value: min })), (a, b) => a > b);
  const most = tightest(said.map(({ by, max }) => ({ by, value: max })), (a, b) => a < b);
  return {
    param, label: labelFor(param, schema), unit: schema.unit ?? unitOf(param),
    min: least.value, max: most.value, minBy: least.by, maxBy: most.by,
    tightened: least.by !== own.by || most.by !== own.by,
  };
}

function limitOf(schema: InputSchema, facts: ProfilePolicy): { by: string; min: undefined; max: number | undefined }[] {
  const name = schema['x-limit'];
  const limit = name === undefined ? undefined : facts.limits?.[name];
  return name === undefined || limit === undefined ? [] : [{ by: `${name}${source(limit.source)}`, min: undefined, max: limit.max }];
}

/** The tightest of what is said, and who says it first. */
function tightest(said: readonly { by: string; value: number | undefined }[], tighter: (a: number, b: number) => boolean): { by: string; value: number | null } {
  return said.reduce<{ by: string; value: number | null }>(
    (best, { by, value }) => (value !== undefined && (best.value === null || tighter(value, best.value)) ? { by, value } : best),
    { by: said[0]?.by ?? '', value: null },
  );
}

function source(text: string | undefined): string {
  return text === undefined || text === '' ? '' : ` (${text})`;
}

function asked(capability: Capability, facts: ProfilePolicy, marked: string): Square['asks'] {
  const approval = facts.authority?.approval ?? null;
  if (approval === null || capability.recovery === true) return null;
  const modes = facts.authority?.modes ?? [];
  if (!required(modes, approval.risk.includes(capability.risk), marked === 'approval-required')) return null;
  return { people: approval.approvers[capability.risk] ?? approval.approvers['default'] ?? 1, withinS: approval.within_s, onTimeout: approval.on_timeout };
}

function required(modes: readonly string[], atItsRisk: boolean, isMarked: boolean): boolean {
  return (modes.includes('approval-required') && atItsRisk) || (isMarked && modes.some((mode) => ASKING.has(mode)));
}

/** `Speed at most 0.25 m/s`, `Clearance 0.3 to 1 m`. */
export function boundText({ label: name, unit, min, max }: Bound): string {
  const tail = unit === '' ? '' : ` ${unit}`;
  if (min !== null && max !== null) return `${name} ${min} to ${max}${tail}`;
  if (max !== null) return `${name} at most ${max}${tail}`;
  return min === null ? name : `${name} at least ${min}${tail}`;
}

/** The phases of a square that a person confirms, for a glance: `Confirm before lift, release`; empty where there are none. */
export function confirmText(confirms: readonly Confirming[]): string {
  const phases = confirms.flatMap((entry) => entry.phases.map(phaseWords));
  return phases.length === 0 ? '' : `Confirm before ${phases.join(', ')}`;
}

const ENDINGS: Record<string, string> = { terminate: 'ends the session', rollback: 'has it rolled back' };

/** What happens before such phases, whole: who is waited for, for how long, and what becomes of it otherwise. */
export function confirmRule({ phases, within_s: withinS, on_deny: denied, on_timeout: silent }: Confirming): string {
  const [deny, silence] = [denied, silent].map((ending) => entryOf(ENDINGS, ending) ?? ending);
  const otherwise = deny === silence ? `a denial or silence ${deny}` : `a denial ${deny}, silence ${silence}`;
  return `Before ${phases.map(phaseWords).join(' and before ')} the robot holds and waits for one person, at most ${withinS} s; ${otherwise}.`;
}

function phaseWords(phase: string): string {
  return phase.replaceAll('_', ' ');
}

/** What a rule does, in words. */
export function effectOf(rule: Rule): string {
  if (rule.then === 'deny') return 'Denies';
  if (rule.then === 'escalate') return (rule.approvers ?? 1) > 1 ? `Asks ${rule.approvers} people` : 'Asks a person';
  if (rule.then === 'allow') return 'Allows';
  const parts = Object.entries(rule.set).map(([param, { min, max, to }]) => {
    const unit = unitOf(param) === '' ? '' : ` ${unitOf(param)}`;
    if (to !== undefined) return `${labelOf(param)}: ${to}`;
    const said = [min === undefined ? '' : `at least ${min}${unit}`, max === undefined ? '' : `at most ${max}${unit}`];
    return `${labelOf(param)} ${said.filter((text) => text !== '').join(', ')}`;
  });
  return `Bounds: ${parts.join('; ')}`;
}

/** Where a rule comes from: the organization, or a profile's file. */
export function sourceOf(rule: Rule): string {
  const owner = rule.id.split('/')[0] ?? rule.id;
  return owner === 'organization' ? 'Organization, in every profile' : `File ${owner}`;
}

/** The square to move to by an arrow key; stays within the matrix. */
export function moved(at: readonly [number, number], key: string, rows: number, columns: number): [number, number] {
  const [row, column] = at;
  const steps: Record<string, [number, number]> = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1], Home: [0, -columns], End: [0, columns] };
  const [down, right] = steps[key] ?? [0, 0];
  const clamp = (value: number, top: number): number => Math.min(top - 1, Math.max(0, value));
  return [clamp(row + down, rows), clamp(column + right, columns)];
}
