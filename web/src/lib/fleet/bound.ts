import type { Capability, Confirming, PolicySet } from '../api/documents';
import { words } from '../format/capability';
import { plain } from '../format/plain';
import { ruleWords } from '../format/rules';
import { confirmRule, effectOf, type Rule } from '../policy/matrix';
import { askingOf } from './profiles';
import type { Difference, Way } from './ways';

type Holding = Pick<PolicySet, 'rules' | 'authority' | 'profiles'>;
const NONE = 'no such rule';
const UNCONFIRMED = 'nobody confirms a phase';

const FORBIDDEN = 'forbidden';
const ASKS = 'approval-required';

type Marked = Pick<Capability, 'name' | 'env_profile' | 'recovery'>;

/** What holds in one of two profiles alone: capabilities that are forbidden or ask a person there, rules that are bound to it, and phases that wait for a person. */
export function boundDifferences(policy: Holding, capabilities: readonly Marked[], from: string, to: string): Difference[] {
  return [
    ...capabilities.flatMap((one) => ofMarks(one, from, to)),
    ...ofAsking(policy, capabilities, from, to),
    ...ofRules(policy.rules as unknown as Rule[], from, to),
    ...ofConfirming(policy.authority?.confirm_before ?? [], from, to),
  ];
}

function ofMarks({ name, env_profile: marks }: Marked, from: string, to: string): Difference[] {
  const [a, b] = [from, to].map((profile) => (marks?.[profile] ?? FORBIDDEN) === FORBIDDEN);
  const text = (forbidden: boolean | undefined): string => (forbidden === true ? 'forbidden' : 'not forbidden');
  return a === b ? [] : [{ what: words(name), from: text(a), to: text(b), way: a === true ? 'looser' : 'stricter' }];
}

/** Capabilities by whose mark a person is asked in one of two profiles alone, if these ask alike otherwise; else the way they ask says it. */
function ofAsking({ profiles }: Holding, capabilities: readonly Marked[], from: string, to: string): Difference[] {
  const [one, other] = [from, to].map((profile) => askingOf(profiles[profile]));
  if (one?.text !== other?.text || one?.mode.startsWith('approval') !== true) return [];
  return capabilities.flatMap(({ name, env_profile: marks, recovery }): Difference[] => {
    const [a = FORBIDDEN, b = FORBIDDEN] = [marks?.[from], marks?.[to]];
    if (recovery === true || a === FORBIDDEN || b === FORBIDDEN || (a === ASKS) === (b === ASKS)) return [];
    const text = (mark: string): string => (mark === ASKS ? 'asks a person' : 'asks no one by itself');
    return [{ what: words(name), from: text(a), to: text(b), way: a === ASKS ? 'looser' : 'stricter' }];
  });
}

function ofRules(rules: readonly Rule[], from: string, to: string): Difference[] {
  const [mine, theirs] = [[from, to], [to, from]].map(([here, there]) => rules.filter(({ profiles }) => profiles?.includes(here ?? '') === true && !profiles.includes(there ?? '')));
  const rest = new Set(theirs);
  const pairs = (mine ?? []).map((rule): [Rule | undefined, Rule | undefined] => {
    const other = [...rest].find(({ id }) => nameOf(id) === nameOf(rule.id));
    if (other !== undefined) rest.delete(other);
    return [rule, other];
  });
  return [...pairs, ...[...rest].map((rule): [undefined, Rule] => [undefined, rule])].flatMap(([a, b]) => ofRule(a, b));
}

function nameOf(id: string): string {
  return id.replace(/^.*\//, '');
}

function ofRule(a: Rule | undefined, b: Rule | undefined): Difference[] {
  const known = a ?? b;
  if (known === undefined || (a !== undefined && b !== undefined && contentOf(a) === contentOf(b))) return [];
  return [{ what: `Rule “${ruleWords(known.id)}”`, from: wordsOf(a), to: wordsOf(b), way: wayOf(a, b) }];
}

function contentOf({ applies_to: scope, when, then, set, approvers }: Rule): string {
  return JSON.stringify([scope, when, then, set, approvers ?? null]);
}

/** A rule that allows is the only one that a profile is stricter without. */
function wayOf(a: Rule | undefined, b: Rule | undefined): Way {
  if (a !== undefined && b !== undefined) return 'different';
  return (a ?? b)?.then === 'allow' ? (a === undefined ? 'looser' : 'stricter') : a === undefined ? 'stricter' : 'looser';
}

/** `Bounds: Clearance at least 0.3 m, in carry, drive; always`. */
function wordsOf(rule: Rule | undefined): string {
  if (rule === undefined) return NONE;
  const scope = rule.applies_to === null ? 'whatever is proposed' : rule.applies_to.map(words).join(', ');
  return `${effectOf(rule)}; ${scope}${rule.when === null ? '' : `, when ${plain(rule.when)}`}`;
}

function ofConfirming(all: readonly Confirming[], from: string, to: string): Difference[] {
  const names = [...new Set(all.filter(({ profile }) => profile === from || profile === to).map(({ capability }) => capability))];
  return names.flatMap((capability) => {
    const [a, b] = [from, to].map((profile) => all.filter((one) => one.capability === capability && one.profile === profile));
    const text = (some: readonly Confirming[] | undefined): string => (some === undefined || some.length === 0 ? UNCONFIRMED : some.map(confirmRule).join(' '));
    if (text(a) === text(b)) return [];
    return [{ what: `Confirming during “${words(capability)}”`, from: text(a), to: text(b), way: b?.length === 0 ? 'looser' : a?.length === 0 ? 'stricter' : 'different' }];
  });
}
