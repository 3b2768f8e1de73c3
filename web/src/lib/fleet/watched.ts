import type { Watched, WatchRule } from '../api/documents';
import { words } from '../format/capability';
import { entryOf } from '../format/entry';
import { labelOf, withUnit } from '../format/quantity';
import { isNearness, ruleWords } from '../format/rules';
import { FEWER, MORE, ofNumbers, together, type Difference, type Way } from './ways';

/** What a profile watches. */
export type Watching = Watched['profiles'][string];
type Pair = [WatchRule | undefined, WatchRule | undefined];
type Part = Omit<Difference, 'what'>;

const COMPUTED: Record<string, string> = {
  protective_separation_m: 'the protective distance',
  timeout_s: 'the time limit',
  retry_budget: 'the retries there are',
  stale_after_ms: 'the age it may have',
};
const DOES: Record<string, string> = { CONTINUE: 'only warns', PAUSE: 'pauses', STOP: 'stops', ROLLBACK: 'rolls back', ESCALATE: 'asks a person' };

/** What becomes of people who come near. */
export function nearDifferences(from: Watching, to: Watching): Difference[] {
  return [
    ...paired(from.watch.filter(isNear), to.watch.filter(isNear)).flatMap(([a, b]) => ofRule('A person too near', a, b)),
    ...ofNumbers('Protective distance, from', from.separation ?? {}, to.separation ?? {}, FEWER, (name, value) => `${labelOf(name).toLowerCase()} ${withUnit(name, value)}`),
  ];
}

/** What else is watched otherwise. */
export function watchDifferences(from: Watching, to: Watching): Difference[] {
  const [mine, theirs] = [from, to].map(({ watch }) => watch.filter((rule) => !isNear(rule)));
  return [
    ...paired(mine ?? [], theirs ?? []).flatMap(([a, b]) => ofRule(ruleWords((a ?? b)?.id ?? ''), a, b)),
    ...ofNumbers('Sensor stale after', from.stale_after_ms, to.stale_after_ms, MORE, (name, value) => `${name} ${value} ms`),
  ];
}

function isNear({ id, signal }: WatchRule): boolean {
  return signal === 'separation_m' || isNearness(id);
}

/** A rule is the same one by its name, or where it has another one by what it watches. */
function paired(from: readonly WatchRule[], to: readonly WatchRule[]): Pair[] {
  const rest = new Set(to);
  const pairs = from.map((rule): Pair => {
    const left = [...rest];
    const other = left.find(({ id }) => id === rule.id) ?? left.find(({ id, signal, above }) => signal === rule.signal && above === rule.above && !from.some((one) => one.id === id));
    if (other !== undefined) rest.delete(other);
    return [rule, other];
  });
  return [...pairs, ...[...rest].map((rule): Pair => [undefined, rule])];
}

function ofRule(what: string, a: WatchRule | undefined, b: WatchRule | undefined): Difference[] {
  if (a === undefined || b === undefined) return [{ what, from: whole(a), to: whole(b), way: b === undefined ? 'looser' : 'stricter' }];
  const parts = [ofThreshold(a, b), ofDuration(a, b), ofScope(a, b), ofResponse(a, b)].filter((part) => part !== null);
  if (parts.length === 0) return [];
  const all = (side: 'from' | 'to'): string => parts.map((part) => part[side]).join(', ');
  return [{ what, from: all('from'), to: all('to'), way: together(parts.map(({ way }) => way)) }];
}

function whole(rule: WatchRule | undefined): string {
  return rule === undefined ? 'not watched' : `${thresholdWords(rule)}, ${responseParts(rule).join(', ')}`;
}

function ofThreshold(a: WatchRule, b: WatchRule): Part | null {
  const [from, to] = [thresholdWords(a), thresholdWords(b)];
  return from === to ? null : { from, to, way: thresholdWay(a, b) };
}

function thresholdWay(a: WatchRule, b: WatchRule): Way {
  const [x, y] = [numberOf(a, b), numberOf(b, a)];
  if (x === null || y === null || a.signal !== b.signal || a.above !== b.above) return 'different';
  return (b.above ? MORE : FEWER)(x, y);
}

/** What a threshold is compared by: a number, or a factor where both are of the same limit. */
function numberOf({ threshold: mine }: WatchRule, { threshold: theirs }: WatchRule): number | null {
  if (typeof mine === 'number') return typeof theirs === 'number' ? mine : null;
  return typeof mine === 'object' && typeof theirs === 'object' && mine.limit === theirs.limit ? mine.times : null;
}

function thresholdWords({ signal, above, threshold }: WatchRule): string {
  const side = above ? 'above' : 'below';
  if (typeof threshold === 'number') return `${side} ${withUnit(signal, threshold)}`;
  if (typeof threshold === 'string') return `${side} ${entryOf(COMPUTED, threshold) ?? words(threshold)}`;
  return `${side} ${Number((threshold.times * 100).toPrecision(6))} % of its limit`;
}

function ofDuration({ for_ms: a }: WatchRule, { for_ms: b }: WatchRule): Part | null {
  const text = (forMs: number): string => (forMs === 0 ? 'at once' : `for ${forMs} ms`);
  return a === b ? null : { from: text(a), to: text(b), way: MORE(a, b) };
}

function ofScope({ applies_to: a }: WatchRule, { applies_to: b }: WatchRule): Part | null {
  const text = (scope: readonly string[] | null): string => (scope === null ? 'whatever runs' : `in ${scope.map(words).join(', ')}`);
  if (text(a) === text(b)) return null;
  const covered = b === null || a?.every((name) => b.includes(name)) === true;
  return { from: text(a), to: text(b), way: covered ? 'stricter' : 'looser' };
}

/** A warning holds nothing. Of what does, nobody tells beforehand which is stricter: a stop ends what a pause would hold for long. */
function ofResponse(a: WatchRule, b: WatchRule): Part | null {
  const [mine, theirs] = [responseParts(a), responseParts(b)];
  if (mine.join() === theirs.join()) return null;
  const [before, after] = [a, b].map(({ response }) => response.enter === 'CONTINUE');
  const told = (parts: readonly string[], other: readonly string[]): string => (before === after && mine[0] === theirs[0] ? parts.filter((part) => !other.includes(part)) : parts).join(', ');
  return { from: told(mine, theirs), to: told(theirs, mine), way: before === after ? 'different' : after === true ? 'looser' : 'stricter' };
}

/** `pauses`, `goes on 1 s after it is clear`, `asks a person after 5 s`: only a pause has more to say than what it does. */
function responseParts({ signal, response: { enter, ...after } }: WatchRule): string[] {
  const does = (name: string): string => entryOf(DOES, name) ?? words(name.toLowerCase());
  if (enter !== 'PAUSE') return [does(enter)];
  const beyond = after.clear_beyond === 0 ? '' : ` by ${withUnit(signal, after.clear_beyond)}`;
  const clear = after.then === 'resume' ? `goes on ${after.clear_after_ms / 1000} s after it is clear${beyond}` : 'stays so';
  return [does(enter), clear, after.persist_ms === null ? 'waits as long as it takes' : `${does(after.else)} after ${after.persist_ms / 1000} s`];
}
