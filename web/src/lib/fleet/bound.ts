import type { Capability, Confirming, PolicySet } from '../api/documents';
import { words } from '../format/capability';
import { entryOf } from '../format/entry';
import { plain } from '../format/plain';
import { ruleWords } from '../format/rules';
import { confirmRule, effectOf, type Rule } from '../policy/matrix';
import { askingOf, type ProfileFacts } from './profiles';
import { FEWER, MORE, together, type Difference, type Way } from './ways';

type Holding = Pick<PolicySet, 'rules' | 'authority' | 'profiles'>;
const NONE = 'no such rule';
const MAY_DIFFER = 'may differ: its condition goes by the profile';
const UNCONFIRMED = 'nobody confirms a phase';

const FORBIDDEN = 'forbidden';
const ASKS = 'approval-required';

type Marked = Pick<Capability, 'name' | 'env_profile' | 'recovery'> & Partial<Pick<Capability, 'risk'>>;

/** What holds in one of two profiles alone: capabilities that are forbidden or ask a person there, rules that are bound to it, and phases that wait for a person. */
export function boundDifferences(policy: Holding, capabilities: readonly Marked[], from: string, to: string): Difference[] {
  return [
    ...capabilities.flatMap((one) => ofMarks(one, from, to)),
    ...ofAsking(policy, capabilities, from, to),
    ...ofRules(policy, from, to),
    ...ofConfirming(policy.authority?.confirm_before ?? [], from, to),
  ];
}

function ofMarks({ name, env_profile: marks }: Marked, from: string, to: string): Difference[] {
  const [a, b] = [from, to].map((profile) => (marks?.[profile] ?? FORBIDDEN) === FORBIDDEN);
  const text = (forbidden: boolean | undefined): string => (forbidden === true ? 'forbidden' : 'not forbidden');
  return a === b ? [] : [{ what: words(name), from: text(a), to: text(b), way: a === true ? 'looser' : 'stricter' }];
}

/** Capabilities that a person is asked about in one of two profiles alone, by their mark, where both ask at all: else the way they ask says it. */
function ofAsking({ profiles }: Holding, capabilities: readonly Marked[], from: string, to: string): Difference[] {
  const [one, other] = [from, to].map((profile) => askingOf(profiles[profile]));
  if (one?.mode.startsWith('approval') !== true || other?.mode.startsWith('approval') !== true) return [];
  return capabilities.flatMap((capability): Difference[] => {
    const [mark, otherMark] = [from, to].map((profile) => capability.env_profile?.[profile] ?? FORBIDDEN);
    if (capability.recovery === true || [mark, otherMark].includes(FORBIDDEN) || (mark === ASKS) === (otherMark === ASKS)) return [];
    const { risk = '' } = capability;
    const [a, b] = [mark === ASKS || one.risk.includes(risk), otherMark === ASKS || other.risk.includes(risk)];
    return a === b ? [] : [{ what: words(capability.name), from: askedWords(a), to: askedWords(b), way: a ? 'looser' : 'stricter' }];
  });
}

function askedWords(so: boolean): string {
  return so ? 'asks a person' : 'asks no one by itself';
}

function ofRules({ rules, profiles }: Holding, from: string, to: string): Difference[] {
  const all = rules as unknown as Rule[];
  const holds = (rule: Rule, profile: string): boolean => (rule.profiles?.includes(profile) ?? true) && mayHold(rule.when, profile, profiles[profile]);
  const [mine, theirs] = ([[from, to], [to, from]] as const).map(([here, there]) => all.filter((rule) => holds(rule, here) && !holds(rule, there)));
  const rest = new Set(theirs);
  const pairs = (mine ?? []).map((rule): [Rule | undefined, Rule | undefined] => {
    const other = [...rest].find(({ id }) => nameOf(id) === nameOf(rule.id));
    if (other !== undefined) rest.delete(other);
    return [rule, other];
  });
  return [
    ...[...pairs, ...[...rest].map((rule): [undefined, Rule] => [undefined, rule])].flatMap(([a, b]) => ofRule(a, b)),
    ...all.filter((rule) => holds(rule, from) && holds(rule, to) && goesBy(rule.when, { from, to, profiles })).map(ofCondition),
  ];
}

/** Whether a condition may hold under a profile, as far as its parts go by that alone: of others that is not known. */
function mayHold(when: string | null, profile: string, facts: ProfileFacts | undefined): boolean {
  return partsOf(when).every((part) => holdsOf(part, profile, facts) !== false);
}

/** Whether a condition goes by something of the profile that differs between two, so that it may hold in one and not in the other. */
function goesBy(when: string | null, { from, to, profiles }: { from: string; to: string } & Pick<Holding, 'profiles'>): boolean {
  const [a, b] = [profiles[from], profiles[to]];
  const differs = (fact: string | undefined): boolean => fact === undefined || fact === 'name' || a?.[fact] === undefined || a[fact] !== b?.[fact];
  return partsOf(when).some((part) => (holdsOf(part, from, a) ?? holdsOf(part, to, b)) === undefined && [...part.matchAll(NAMES_PROFILE)].some(([, fact]) => differs(fact)));
}

const NAMES_PROFILE = /(?<![.\w])profile\b(?:\s*\.\s*(\w+))?/g;

/** What has to hold all together, or else the condition as it is: a part of one in brackets, or in quotes, says nothing by itself. */
function partsOf(when: string | null): string[] {
  if (when === null) return [];
  const parts = /\|\||\?/.test(when) ? [when] : when.split('&&').map((part) => part.trim());
  return parts.every(isWhole) ? parts : [when];
}

function isWhole(part: string): boolean {
  const count = (letter: string): number => part.split(letter).length - 1;
  return ['()', '[]', '{}'].every(([open = '', close = '']) => count(open) === count(close)) && ['"', "'"].every((quote) => count(quote) % 2 === 0);
}

/** Whether a part of a condition holds under a profile; undefined where it takes more than that to know. */
function holdsOf(part: string, profile: string, facts: ProfileFacts | undefined): boolean | undefined {
  if (/^!?profile\.shared_floor$/.test(part)) return facts?.shared_floor === undefined ? undefined : facts.shared_floor !== part.startsWith('!');
  const [, is, , name] = /^profile\.name\s*(==|!=)\s*(["'])([^"'\\]*)\2$/.exec(part) ?? [];
  return name === undefined ? undefined : (name === profile) === (is === '==');
}

function ofCondition(rule: Rule): Difference {
  return { what: `Rule “${ruleWords(rule.id)}”`, from: wordsOf(rule), to: MAY_DIFFER, way: 'different' };
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

const STRENGTH: readonly string[] = ['allow', 'modify', 'escalate', 'deny'];

/** A rule that allows is the only one that a profile is stricter without. */
function wayOf(a: Rule | undefined, b: Rule | undefined): Way {
  if (a !== undefined && b !== undefined) return betweenTwo(a, b);
  return (a ?? b)?.then === 'allow' ? (a === undefined ? 'looser' : 'stricter') : a === undefined ? 'stricter' : 'looser';
}

/** Of two that go by the same name: which is the stricter one is known only where they are about the same. */
function betweenTwo(a: Rule, b: Rule): Way {
  if (JSON.stringify([a.applies_to, a.when]) !== JSON.stringify([b.applies_to, b.when])) return 'different';
  if (a.then !== b.then) return FEWER(STRENGTH.indexOf(a.then), STRENGTH.indexOf(b.then));
  if (a.then === 'escalate' && a.approvers != null && b.approvers != null) return FEWER(a.approvers, b.approvers);
  return a.then === 'modify' ? together(ofBounds(a.set, b.set)) : 'different';
}

function ofBounds(a: Rule['set'], b: Rule['set']): Way[] {
  return [...new Set([...Object.keys(a), ...Object.keys(b)])].flatMap((name): Way[] => {
    const [one, other] = [entryOf(a, name), entryOf(b, name)];
    if (one === undefined || other === undefined) return [one === undefined ? 'stricter' : 'looser'];
    if (one.to !== other.to) return ['different'];
    return [...ofBound(one.max, other.max, Infinity, MORE), ...ofBound(one.min, other.min, -Infinity, FEWER)];
  });
}

function ofBound(a: number | undefined, b: number | undefined, none: number, way: typeof MORE): Way[] {
  return a === b ? [] : [way(a ?? none, b ?? none)];
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
