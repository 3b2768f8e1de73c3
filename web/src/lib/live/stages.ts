import type { Change, Escalation, Invocation, LogEvent } from '../api/documents';
import { outcomeTone, outcomeWords, type Tone } from '../format/status';
import { clockTime } from '../format/time';
import type { Holders } from './control';
import { iApproved } from './urgency';

export const STAGES = ['Goal', 'Proposal', 'Decision', 'Launch', 'Watch', 'Recover', 'Outcome'] as const;
export type StageName = (typeof STAGES)[number];
/** `now`: here the session stands; `held`: here somebody paused it; `asks`: here it waits for a person; `bad`: here something went wrong. */
export type StageState = 'done' | 'now' | 'held' | 'asks' | 'bad' | 'skipped' | 'open';

export interface Stage {
  name: StageName;
  state: StageState;
  note: string;
}

/** Says for whom questions wait, as the person who looks sees it: whoever may not answer is not told to. */
export function awaited(me: { role: string } | null): string {
  return me === null || me.role === 'operator' ? 'you' : 'operators';
}

/** Says of a question for whom it waits, as the person who looks sees it; `escalation` is the one that is open, if any. */
export function askedOf(escalation: Escalation | null, me: { name: string; role: string } | null): string {
  if (awaited(me) !== 'you') return 'asks a person';
  if (escalation === null || !iApproved(escalation, me?.name ?? null)) return 'waits for you';
  return `needs ${escalation.needed - escalation.approvals.length} more`; // a column of the strip holds some 14 letters
}

/** Who holds it is not known, or nobody does. */
const NOBODY: Holders = { operator: false, watch: false };

/** Where an invocation stands in the seven stages, from its document and its events; `asked` says for whom it waits, `driven` that a person has the controls. */
export function stagesOf(invocation: Invocation, log: readonly LogEvent[], asked = 'waits for you', holders = NOBODY, driven = false): Stage[] {
  const events = log.filter((event) => event.invocation === invocation.id);
  const at = (kind: string): LogEvent | undefined => events.find((event) => event.kind === kind);
  const time = (event: LogEvent | undefined): string => (event === undefined ? '' : clockTime(event.at));
  const proposed = time(at('proposal')) || clockTime(invocation.created_at);
  return [
    { name: 'Goal', state: 'done', note: proposed },
    proposal(invocation, proposed),
    decision(invocation, asked),
    launch(invocation, at('launch'), time(at('launch'))),
    watch(invocation, events, asked, holders, driven),
    recover(invocation, events, asked, at('launch') !== undefined),
    outcome(invocation),
  ];
}

function launched(invocation: Invocation): boolean {
  if (['running', 'paused', 'escalated', 'recovering', 'taken_over', 'completed'].includes(invocation.status)) return true;
  return invocation.status === 'failed';
}

function proposal(invocation: Invocation, time: string): Stage {
  const outcome = invocation.admission.outcome;
  if (outcome === 'reject') return { name: 'Proposal', state: 'bad', note: 'rejected' };
  if (outcome === 'defer') return { name: 'Proposal', state: 'bad', note: 'deferred' };
  return { name: 'Proposal', state: 'done', note: time };
}

function decision(invocation: Invocation, asked: string): Stage {
  if (invocation.status === 'awaiting_approval') return { name: 'Decision', state: 'asks', note: asked };
  if (invocation.status === 'denied') return undecided(invocation.outcome ?? 'denied');
  const policy = invocation.policy;
  if (policy === null) return unbegun('Decision', invocation, 'not decided');
  return { name: 'Decision', state: 'done', note: policy.changes.length === 0 ? 'allowed' : changed(policy.changes) };
}

/** What ended before it began: by a denial, by silence, or by a word that was no answer, as of who called it off. */
function undecided(outcome: string): Stage {
  return { name: 'Decision', state: outcomeTone(outcome) === 'quiet' ? 'skipped' : 'bad', note: outcomeWords(outcome) };
}

/** What is raised, or added, or another name is not cut. */
function changed(changes: readonly Change[]): string {
  const cut = changes.every(({ requested, effective }) => typeof requested === 'number' && typeof effective === 'number' && effective < requested);
  if (!cut) return `${changes.length} changed`; // a column of the strip holds some 14 letters
  return `${changes.length} value${changes.length === 1 ? '' : 's'} cut`;
}

function launch(invocation: Invocation, event: LogEvent | undefined, time: string): Stage {
  if (event !== undefined && 'refused' in event.body) return { name: 'Launch', state: 'bad', note: 'refused' };
  if (event === undefined && !launched(invocation)) return unbegun('Launch', invocation, 'not launched');
  return { name: 'Launch', state: 'done', note: time || 'launched' };
}

/** What has not begun, or never will: a proposal that is over was not launched. */
function unbegun(name: StageName, invocation: Invocation, never: string): Stage {
  return invocation.outcome === null ? { name, state: 'open', note: 'open' } : { name, state: 'skipped', note: never };
}

function watch(invocation: Invocation, events: readonly LogEvent[], asked: string, { operator, watch }: Holders, driven: boolean): Stage {
  if (!launched(invocation)) return unbegun('Watch', invocation, 'nothing ran');
  const counted = violationsIn(events);
  switch (invocation.status) {
    case 'running':
      return { name: 'Watch', state: 'now', note: counted || (driven ? 'driven by hand' : 'running') };
    case 'paused':
      if (operator && !watch) return { name: 'Watch', state: 'held', note: 'paused' };
      return counted === '' ? { name: 'Watch', state: 'held', note: 'paused' } : { name: 'Watch', state: 'bad', note: counted };
    default:
      return confirming(invocation, events) ? { name: 'Watch', state: 'asks', note: asked } : watched(counted);
  }
}

function watched(counted: string): Stage {
  return { name: 'Watch', state: counted === '' ? 'done' : 'bad', note: counted || 'no violation' };
}

/** Whether it waits for a person to confirm a phase, as policy says: there is nothing to recover from then. */
function confirming(invocation: Invocation, events: readonly LogEvent[]): boolean {
  if (invocation.status !== 'escalated') return false;
  const asked = events.filter((event) => event.kind === 'escalation').sort((a, b) => b.seq - a.seq)[0]?.body['escalation'];
  return typeof asked === 'object' && asked !== null && 'phase' in asked && typeof asked.phase === 'string';
}

function violationsIn(events: readonly LogEvent[]): string {
  const count = events.filter((event) => event.kind === 'alert' && event.body['signal'] === 'VIOLATION').length;
  if (count === 0) return '';
  return count === 1 ? '1 violation' : `${count} violations`;
}

function recover(invocation: Invocation, events: readonly LogEvent[], asked: string, begun: boolean): Stage {
  const steps = events.filter((event) => event.kind === 'recovery').length;
  const counted = `${steps} step${steps === 1 ? '' : 's'}`;
  if (confirming(invocation, events)) return { name: 'Recover', state: 'open', note: 'open' };
  if (invocation.status === 'escalated') return { name: 'Recover', state: 'asks', note: asked };
  if (invocation.status === 'recovering') return { name: 'Recover', state: 'now', note: counted };
  if (steps > 0) return { name: 'Recover', state: 'done', note: counted };
  if (invocation.outcome === 'recovered') return { name: 'Recover', state: 'done', note: byHand(events) ? 'by hand' : 'new attempt' };
  return unbegun('Recover', invocation, begun && asksAPerson(events) ? 'ended instead' : 'not needed');
}

/** Whether the session was held for a person to say what becomes of it. */
function asksAPerson(events: readonly LogEvent[]): boolean {
  return events.some(({ kind, body }) => kind === 'intervention' && body['intervention'] === 'ESCALATE');
}

function byHand(events: readonly LogEvent[]): boolean {
  return events.some((event) => event.kind === 'human' && event.body['op'] === 'takeover');
}

const OUTCOME_STATES: Partial<Record<Tone, Stage['state']>> = { ok: 'done', human: 'held', quiet: 'skipped' };

function outcome(invocation: Invocation): Stage {
  if (invocation.outcome === null) return { name: 'Outcome', state: 'open', note: 'open' };
  return { name: 'Outcome', state: OUTCOME_STATES[outcomeTone(invocation.outcome)] ?? 'bad', note: outcomeWords(invocation.outcome) };
}
