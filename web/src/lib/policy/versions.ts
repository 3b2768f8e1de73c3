/** What is said of versions of policy, and who may do what about them. Whatever is shown, the server decides. */
import type { Comparison, Direction, Version } from '../api/documents';
import type { Tone } from '../format/status';

/** Names of capabilities are small letters, so this is none. */
export const PLACE = 'Versions';
export const NEW = 'new';

export const STATUS: Record<Version['status'], { text: string; tone: Tone }> = {
  active: { text: 'In force', tone: 'ok' },
  awaiting_second: { text: 'Waits for another engineer', tone: 'warn' },
  candidate: { text: 'Candidate', tone: 'accent' },
  former: { text: 'Was in force', tone: 'quiet' },
};

/** What is known of a version's proofs. Only what a start brought is anything but proved. */
export const PROOFS: Record<Version['verdict'], { says: string; tone: Tone }> = {
  proved: { says: 'Proved', tone: 'ok' },
  refuted: { says: 'Does not pass its proofs: the record says where', tone: 'danger' },
  undecided: { says: 'Not everything about it could be proved', tone: 'warn' },
  unknown: { says: 'Not proved: a start brought it', tone: 'quiet' },
};

export const DIRECTION: Record<Direction, { text: string; says: string; tone: Tone }> = {
  same: { text: 'No effect', says: 'No decision comes out otherwise.', tone: 'quiet' },
  tightens: { text: 'Tightens', says: 'Nothing is allowed that was not allowed before.', tone: 'plain' },
  loosens: { text: 'Loosens', says: 'Something is allowed that was not allowed before.', tone: 'warn' },
  both: { text: 'Tightens and loosens', says: 'Some things are allowed that were not, and others no longer.', tone: 'warn' },
};

export function shortVersion(digest: string): string {
  return digest.replace(/^sha256:/, '').slice(0, 12);
}

export interface Deed {
  label: string;
  /** What will come of it. */
  says: string;
  /** Why it cannot be done; null where it can. */
  barrier: string | null;
}

/** Why a form cannot be sent yet: nothing goes into the record without a reason. */
export const SAY_WHY = 'Say why first: it stays in the record.';

export interface Who {
  name: string;
  role: string;
}

export interface Situation {
  version: Version;
  /** What is in force. */
  active: Version | null;
  who: Who | null;
  live: boolean;
  /** What the version would change, once that is known. */
  found: Comparison | null;
}

/** What may be done to put a version in force; null where it is. */
export function deedOf(of: Situation): Deed | null {
  if (of.version.status === 'active') return null;
  const first = wordGiven(of);
  return { label: first === null ? labelOf(of) : 'Give the second word', says: outlook(of, first), barrier: barrierOf(of, first) };
}

/** Who gave the first word on it in the place of what is in force now. */
function wordGiven({ version, active }: Situation): string | null {
  const { awaiting } = version;
  return awaiting !== null && stands(awaiting.against, awaiting.at, active) ? awaiting.by : null;
}

/** Whether a word was said of what is in force, since it is: what has changed meanwhile makes it a word on another change. */
function stands(against: string | null, at: string, active: Version | null): boolean {
  return active !== null && against === active.digest && at >= (active.activations.at(-1)?.at ?? active.created_at);
}

function labelOf(of: Situation): string {
  const { version, active } = of;
  // Whoever comes first puts nothing in force where it takes two, and the button does not say so.
  if (takesTwo(of)) return 'Give the first word';
  if (version.activations.length === 0) return 'Put in force';
  return active?.activations.at(-1)?.former === version.digest ? 'Roll back to this' : 'Put in force again';
}

function barrierOf({ who, live, active, found }: Situation, first: string | null): string | null {
  if (who?.role !== 'engineer') return 'Engineers put versions in force; you may look.';
  if (!live) return 'The link is down: nothing but a stop is sent.';
  if (active === null) return 'What is in force is not known yet.';
  if (first === who.name) return 'You gave the first word: another engineer has to give the second.';
  if (found === null) return 'What it changes has to be compared first.';
  return null;
}

function outlook(of: Situation, first: string | null): string {
  if (first !== null) return `${first} wants it in force; with another engineer’s word it is.`;
  if (of.found === null) return 'What it changes is being compared.';
  if (!loosens(of.found)) return 'It loosens nothing: one engineer is enough.';
  if (!takesTwo(of)) return `It loosens something; ${of.version.by} brought it, so your word is the second.`;
  return 'It loosens something: yours is the first word, and another engineer has to give the second.';
}

function loosens({ direction }: Comparison): boolean {
  return direction !== 'same' && direction !== 'tightens';
}

/** Whether a word that is given now is only the first of two. */
function takesTwo(of: Situation): boolean {
  return of.found !== null && loosens(of.found) && !(vouched(of) && of.version.by !== of.who?.name);
}

/** Whether bringing it counts as the first word: as long as nothing has changed since. */
function vouched({ version, active }: Situation): boolean {
  return version.source === 'request' && version.activations.length === 0 && stands(version.against, version.created_at, active);
}

/** Which way decisions of a group of the shadow go, in words. */
export function decidedAs(said: string): string {
  const [, status, verdict] = /^(\w+) \((\w+)\)$/.exec(said) ?? [];
  if (status === undefined || verdict === undefined) return said;
  const words = status.replaceAll('_', ' ');
  return verdict === 'modify' ? `${words}, with bounds` : words;
}
