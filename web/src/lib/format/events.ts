import type { Escalation, Grant, InputSchema, Invocation, Json, LogEvent } from '../api/documents';
import { deniedWords } from './denied';
import { goodOutcome, outcomeTone, outcomeWords, statusWords, withShortIds, type Tone } from './status';
import { titleOf, words } from './capability';
import { driven } from './driven';
import { newestEdit, stepsText } from './edited';
import { entryOf } from './entry';
import { keptWords } from './kept';
import { cellWords, orderWords, toldWords, undoneWords, versionWords } from './orders';
import { plain } from './plain';
import { labelFor, valueOf } from './quantity';
import { reading, ruleWords } from './rules';
import { clockTime } from './time';

export type EventIcon = 'dot' | 'scale' | 'check' | 'alert' | 'pause' | 'stop' | 'hand' | 'undo' | 'person' | 'plug' | 'flag' | 'log' | 'refused';

/** One line of the event log: an icon, perhaps a strong beginning, and the rest. */
export interface Line {
  icon: EventIcon;
  tone: Tone;
  strong: string;
  text: string;
}

/** What events leave to other documents; without it they are told in fewer words. */
export interface Known {
  /** The inputs of what an invocation does: they say which quantity a parameter is. */
  inputs: (invocation: string | null) => Record<string, InputSchema>;
  grant: (id: string) => Pick<Grant, 'issued_by' | 'expires_at'> | null;
  /** Whether a proposal was refused or put off before policy was asked about it. */
  turnedAway: (verdict: LogEvent) => boolean;
}

const NOTHING_KNOWN: Known = { inputs: () => ({}), grant: () => null, turnedAway: () => false };

type Body = LogEvent['body'];
type Writer = (body: Body, event: LogEvent, known: Known) => Line;

const str = (value: Json | undefined): string => (typeof value === 'string' ? value : '');
const num = (value: Json | undefined): number | null => (typeof value === 'number' ? value : null);
const obj = (value: Json | undefined): Record<string, Json> =>
  value !== null && typeof value === 'object' && !Array.isArray(value) ? value : {};
const list = (value: Json | undefined): Json[] => (Array.isArray(value) ? value : []);
const line = (icon: EventIcon, tone: Tone, text: string, strong = ''): Line => ({ icon, tone, strong, text });

/** A completion that has nothing to verify names nothing. */
function verified(what: readonly string[]): string {
  return what.length === 0 ? 'Done, with nothing for sensors to verify' : `Verified by sensors: ${what.join(', ').replaceAll('_', ' ')}`;
}

function alert(body: Body): Line {
  const rule = str(body['rule']);
  const what = ruleWords(rule);
  switch (str(body['signal'])) {
    case 'NORMAL':
      return line('check', 'quiet', `${what} back within its limit`);
    case 'COMPLETION':
      return line('check', 'quiet', verified(list(body['verified']).map(str)));
    case 'WARNING':
      return line('alert', 'warn', `${what}${reading(rule, num(body['value']), num(body['threshold']))}`);
    default: {
      const binary = rule === 'grip-lost' || rule === 'postcondition' || rule === 'implausible';
      return line('alert', 'danger', binary ? what : `${what}${reading(rule, num(body['value']), num(body['threshold']))}`);
    }
  }
}

const INTERVENTIONS: Record<string, Line> = {
  PAUSE: line('pause', 'warn', ', category 2 stop, power kept', 'Paused'),
  STOP: line('stop', 'danger', ' by the watcher', 'Stopped'),
  ROLLBACK: line('undo', 'warn', ' ordered by the watcher', 'Roll back'),
  ESCALATE: line('hand', 'warn', ' asks a human', 'The watcher'),
};

function intervention(body: Body): Line {
  const what = str(body['intervention']);
  return entryOf(INTERVENTIONS, what) ?? line('dot', 'plain', words(what.toLowerCase()));
}

function changes(body: Body, inputs: Record<string, InputSchema>): string {
  return list(body['changes'])
    .map(obj)
    .map((change) => {
      const name = str(change['param']);
      // Where the capability is not known, the rule still is: profiles name theirs after the limit.
      const limit = entryOf(inputs, name) ?? { 'x-limit': str(change['rule']).replace(/^.*\//, '') };
      return `${labelFor(name, limit)} ${valueOf(name, change['requested'])} → ${valueOf(name, change['effective'])}`;
    })
    .join(', ');
}

/** What policy says to a proposal that comes to nothing all the same. */
const WOULD: Record<string, string> = { allow: 'alone would allow it', modify: 'alone would change it' };

/** Whether admission, which is recorded just before, refused what a verdict of policy is about, or put it off. */
export function turnedAway(events: readonly LogEvent[], verdict: LogEvent): boolean {
  const admitted = events.findLast((event) => event.kind === 'admission' && event.invocation === verdict.invocation && event.seq < verdict.seq);
  return admitted !== undefined && str(admitted.body['outcome']) !== 'accept';
}

function policy(body: Body, event: LogEvent, known: Known): Line {
  const outcome = str(body['outcome']);
  if (outcome === 'deny') return line('refused', 'danger', firstMessage(body), 'Denied by policy. ');
  const cut = changes(body, known.inputs(event.invocation));
  if (known.turnedAway(event)) return line('scale', 'quiet', `Policy ${entryOf(WOULD, outcome) ?? 'would ask a person'}${cut === '' ? '' : `: ${cut}`}`);
  const back = obj(body['hand_back']);
  if ('refused' in back) return line('refused', 'warn', ` cannot hand back yet: ${asked(obj(back['refused']))}`, str(back['by']));
  const granted = str(body['grant']);
  if (body['takeover'] === true) return line('scale', 'quiet', cut === '' ? 'Driving by hand allowed' : `Driving by hand: ${cut}`);
  const again = body['recheck'] === true ? 'Checked again: ' : '';
  if (granted !== '') return line('scale', 'plain', [again + allowedBy(known.grant(granted)), cut].filter((part) => part !== '').join('; '));
  return passed(outcome, again, cut);
}

/** What people are asked about, by the reasons of it. */
function asked(what: Body): string {
  return list(what['reasons']).map((why) => str(obj(why)['message']).replaceAll('`', '').replace(/\.$/, '')).join('; ');
}

function passed(outcome: string, again: string, cut: string): Line {
  switch (outcome) {
    case 'allow':
      if (cut !== '') return line('scale', 'plain', again + cut);
      return line('scale', 'quiet', again === '' ? 'Allowed as proposed' : `${again}still allowed`);
    case 'modify':
      return line('scale', 'plain', again + cut);
    default:
      return line('scale', 'warn', cut === '' ? 'needs a human' : `needs a human; ${cut}`, 'Policy: ');
  }
}

/** What no person was asked about, because one had answered in advance. */
function allowedBy(grant: ReturnType<Known['grant']>): string {
  return grant === null ? 'Allowed by a standing grant' : `Allowed by ${grant.issued_by}’s standing grant until ${clockTime(grant.expires_at)}`;
}

function firstMessage(body: Body): string {
  return str(obj(list(body['reasons'])[0])['message']).replaceAll('`', '');
}

const ADMITTED = [['takeover', 'Driving by hand admitted'], ['recheck', 'Admitted again']] as const;

function admission(body: Body): Line {
  const outcome = str(body['outcome']);
  if (outcome === 'accept') return line('check', 'quiet', ADMITTED.find(([mark]) => body[mark] === true)?.[1] ?? 'Admitted');
  return line('refused', outcome === 'defer' ? 'warn' : 'danger', ` ${firstMessage(body)}`, words(outcome === 'defer' ? 'deferred.' : 'rejected.'));
}

/** An edit counts as an approval of what it made, and is recorded within moments of it. */
const TOGETHER_MS = 1_000;

function editOf(body: Body, event: LogEvent, known: Known): string {
  const asked = obj(body['escalation']) as unknown as Pick<Escalation, 'constrained' | 'effective' | 'edits'> & Partial<Escalation>;
  const edit = newestEdit(asked);
  const approved = asked.approvals?.at(-1);
  const own = approved === undefined || Math.abs(Date.parse(approved.at) - Date.parse(edit?.at ?? '')) < TOGETHER_MS;
  return edit === null || edit.by !== event.actor || !own ? '' : stepsText(edit.steps, known.inputs(event.invocation));
}

function approval(body: Body, event: LogEvent, known: Known): Line {
  const asked = obj(body['escalation']);
  const [given, of] = [list(asked['approvals']).length, num(asked['needed']) ?? 1];
  const voided = of > 1 ? '; no earlier approval counts' : '';
  switch (str(body['decision'])) {
    case 'approve': {
      const edit = editOf(body, event, known);
      return line('check', 'plain', edit === '' ? ` approved, ${given} of ${of}` : ` edited: ${edit}, and approved, ${given} of ${of}${voided}`, event.actor);
    }
    case 'edit': {
      const edit = editOf(body, event, known);
      return line('scale', 'plain', edit === '' ? ' edited the proposal' : ` edited, and policy cut it further: ${edit}${voided}`, event.actor);
    }
    case 'deny':
      return line('refused', 'danger', ` ${deniedWords(asked['denial'])}`, event.actor);
    case 'void':
      return line('refused', 'warn', `The approval of ${list(body['givers']).map(str).join(' and ')} counts no more, with their token; ${given} of ${of}`);
    default:
      return line('hand', 'quiet', `Question ${str(asked['status']) || 'closed'}`);
  }
}

function escalation(body: Body): Line {
  const asked = obj(body['escalation']);
  const status = str(asked['status']);
  if (status !== '' && status !== 'pending') return line('hand', 'quiet', `The question is ${status}`);
  const until = str(asked['expires_at']);
  return line('hand', 'warn', until === '' ? '' : `, deadline ${clockTime(until)}`, 'Asked a person');
}

function recovery(body: Body): Line {
  const strategy = words(str(body['strategy']).toLowerCase());
  const capability = str(body['capability']);
  if (str(body['failure']) === ROLLBACK_FAILED) return line('undo', 'danger', `${leftWords(body['unmet'])}: ${strategy.toLowerCase()}`, 'It could not be undone and verified');
  return line('undo', 'warn', capability === '' ? '' : `: ${words(capability).toLowerCase()}`, strategy);
}

const ROLLBACK_FAILED = 'rollback_failed';

/** What a rollback did not bring back, by sensors. */
const LEFT: Record<string, string> = {
  base_pose: 'the base stands elsewhere',
  holding: 'the gripper holds something else',
  object_pose: 'the object is not as it stood, or out of sight',
  tool_state: 'the tool is not as it was',
};

function leftWords(unmet: Json | undefined): string {
  const left = Array.isArray(unmet) ? unmet.map((name) => entryOf(LEFT, str(name)) ?? words(str(name)).toLowerCase()) : [];
  return left.length === 0 ? '' : ` (${left.join('; ')})`;
}

/** What only a cell says, in its own words; what else it says is an echo of what a person was heard to say. */
const OF_THE_CELL: ReadonlySet<string> = new Set(['jog', 'let_go', 'confirm', 'end_takeover']);

function echo(op: string, body: Body, event: LogEvent): Line | null {
  const order = toldWords(op, body['expired'] === true);
  const refused = str(body['refused']);
  // No hand was on the controls by then, as after a link that was lost: it is no cell that goes on against a word.
  if (op === 'let_go' && refused === 'not_taken_over') return line('dot', 'quiet', ' was let go of already', event.actor);
  if (refused !== '') return line('refused', 'warn', ` does not obey: ${order}, ${undoneWords(refused)}`, event.actor);
  if (body['done'] === false) return line('refused', 'warn', ` does not obey: ${order}`, event.actor);
  return OF_THE_CELL.has(op) ? null : line('dot', 'quiet', ` obeys: ${order}`, event.actor);
}

function human(body: Body, event: LogEvent): Line {
  const op = str(body['op']) || str(body['decision']) || 'spoke';
  const tone = op === 'estop' || op === 'stop' ? 'danger' : op === 'acknowledge' ? 'quiet' : 'human';
  return ('done' in body ? echo(op, body, event) : null) ?? line('person', tone, ` ${op === 'jog' ? driven(body) : orderWords(op)}`, event.actor);
}

function launch(body: Body): Line {
  const refused = str(body['refused']);
  if (refused !== '') return line('refused', 'danger', ` ${undoneWords(refused)}`, 'Launch refused:');
  return line('dot', 'plain', `Launched, authorization ${str(body['permit']).slice(-6)}`);
}

/** What ends a session of which no failure tells: what befell its cell, or whoever drove it. */
const ENDS: Record<string, string> = {
  [ROLLBACK_FAILED]: ROLLBACK_FAILED,
  link: 'ended, as the cell had lost the server',
  control_lapsed: 'ended, as its holder fell silent',
  estop: 'by an emergency stop',
  guard_broken: 'what guards the cell broke', loop_broken: 'what drives the cell broke',
  not_held: 'the arm moved while it was held',
  journal_unavailable: 'the cell could not write its journal',
  another_site: 'the robot works by another site than the policy; restart the cell',
  no_plan: 'the cell had no plan for it',
  cell_restarted: 'the cell was started anew',
  shutdown: 'the cell was shut down',
};

function outcome(body: Body): Line {
  const label = str(body['outcome']);
  const good = goodOutcome(label);
  const why = str(body['failure']) || (entryOf(ENDS, str(body['code'])) ?? '');
  return line(good ? 'flag' : outcomeTone(label) === 'human' ? 'person' : 'stop', outcomeTone(label), why === '' || good ? '' : `, ${why.replaceAll('_', ' ')}`, words(outcomeWords(label)));
}

function status(body: Body): Line {
  const { text } = statusWords(str(body['status']));
  const why = str(body['reason']).toLowerCase().replaceAll('_', ' ');
  return line('dot', 'quiet', why === '' ? text : `${text} (${why})`);
}

/** Why a standing grant ended by itself. */
export const GRANT_ENDS: Record<string, string> = {
  expired: 'ran out',
  estop: 'ended by the emergency stop',
  policy_changed: 'ended with its policy',
  profile_changed: 'ended with its profile',
  giver_withdrawn: 'ended with the token of who gave it',
};

function grant(body: Body, event: LogEvent): Line {
  const given = obj(body['grant']);
  const of = str(given['object']) || str(given['task']);
  const what = `${words(str(given['capability'])).toLowerCase()}${of === '' ? '' : ` ${of}`}`;
  const op = str(body['op']);
  const ended = obj(given['ended']);
  if (str(ended['code']) === 'revoked') return line('refused', 'human', ` revoked a standing grant: ${what}`, str(ended['by']));
  if (op === 'given') return line('check', 'human', ` opened a standing grant: ${what}`, event.actor);
  return line('refused', 'quiet', `Standing grant ${entryOf(GRANT_ENDS, str(ended['code'])) ?? op.replaceAll('_', ' ')}: ${what}`);
}

function review(body: Body, event: LogEvent): Line {
  const about = obj(body['review']);
  const verdict = obj(about['verdict']);
  if (str(body['op']) !== 'verdict') return line('person', 'plain', `: ${outcomeWords(str(about['outcome']))}`, 'Waits for review');
  const note = str(verdict['note']);
  return line('person', 'human', ` reviewed: ${str(verdict['verdict'])}${note === '' ? '' : `, “${note}”`}`, event.actor);
}

function cell(body: Body, event: LogEvent): Line {
  const op = str(body['what']);
  const link = str(body['link']);
  const named = str(body['actor']);
  const by = named === '' ? event.actor : `${named}, says ${event.actor}`; // whose word it was stands in the word's own event
  if (op === 'estop') return line('stop', 'danger', ` obeyed, power off, by ${by}`, 'Emergency stop');
  if (op === 'reset') return line('undo', 'human', `, nothing moved, by ${by}`, 'Reset');
  if (op === 'not_confirmed') return line('stop', 'danger', `: ${str(body['cell'])} has not said that it heard it, and stays stopped until it does`, 'Reset not confirmed');
  if (op === 'confirmed') return line('undo', 'quiet', `: ${str(body['cell'])} is back and says that it has no stop`, 'Reset confirmed');
  if (link !== '') return line('plug', link === 'lost' ? 'danger' : 'quiet', `Cell link ${link}`);
  return line('plug', op === 'broken' ? 'danger' : 'quiet', `Cell: ${cellWords(op || 'report')}`);
}

const WRITERS: Record<string, Writer> = {
  proposal: (body, event) =>
    line('dot', 'plain', `: ${titleOf(str(body['capability']), obj(body['params'])).replace(/^./, (c) => c.toLowerCase())}`, event.actor),
  admission,
  policy,
  escalation,
  approval,
  authorization: () => line('check', 'quiet', 'Authorization signed'),
  launch,
  alert,
  intervention,
  recovery,
  human,
  telemetry: (body) => ({ icon: 'log', ...keptWords(body) }),
  outcome,
  status,
  grant,
  review,
  policy_activated: (body) => line('scale', 'plain', `Policy ${str(body['policy_version']).replace('sha256:', '').slice(0, 7)} in force`),
  policy_version: (body) => {
    const version = str(body['policy_version']).replace('sha256:', '').slice(0, 7);
    return line('scale', body['op'] === 'refuted' ? 'danger' : 'plain', `Policy ${version}: ${versionWords(str(body['op']))}`);
  },
  profile_changed: (body, event) => line('scale', 'human', ` set the profile to ${str(body['profile'])}`, event.actor),
  principal: (body) => line('person', 'quiet', `${str(body['principal'])}: token ${str(body['op'])}`),
  cell,
  boot: () => line('plug', 'quiet', 'Server started'),
};

/** One event in words. */
export function eventLine(event: LogEvent, known: Known = NOTHING_KNOWN): Line {
  const said = entryOf(WRITERS, event.kind)?.(event.body, event, known) ?? line('dot', 'quiet', words(event.kind));
  return { ...said, strong: plain(said.strong), text: plain(withShortIds(said.text)) };
}

/** One line of a log that is read by the newest first, and how often it was said in a row. */
export interface Entry {
  /** The newest of the row. */
  event: LogEvent;
  line: Line;
  times: number;
  /** The cell it was in; null where that is not said. */
  cell: string | null;
  /** What it is about, where the line itself does not say. */
  about: string | null;
}

/** Where something happened: as the event says, or as its session does, or because a cell said it itself. */
export function cellOf(event: LogEvent, { cells, invocations }: { cells: Record<string, unknown>; invocations: Record<string, { cell: string | null }> }): string | null {
  const said = str(event.body['cell']);
  if (said !== '') return said;
  const session = event.invocation === null ? undefined : entryOf(invocations, event.invocation);
  return session?.cell ?? (Object.hasOwn(cells, event.actor) ? event.actor : null);
}

/** What an event is about: the title of its session, as it was proposed where nothing else is known of it. */
export function aboutOf(event: LogEvent, { invocations, events }: { invocations: Record<string, Pick<Invocation, 'capability' | 'requested' | 'effective'>>; events: readonly LogEvent[] }): string | null {
  if (event.invocation === null || event.kind === 'proposal') return null;
  const session = entryOf(invocations, event.invocation);
  if (session !== undefined) return titleOf(session.capability, session.effective ?? session.requested);
  const proposed = events.find((one) => one.kind === 'proposal' && one.invocation === event.invocation);
  return proposed === undefined ? null : titleOf(str(proposed.body['capability']), obj(proposed.body['params']));
}

/** Returns the newest events first, those that say the same in a row as one: a hand on the controls says much. */
export function entriesOf(events: readonly LogEvent[], most: number, where: (event: LogEvent) => string | null = () => null, known = NOTHING_KNOWN, what: (event: LogEvent) => string | null = () => null): Entry[] {
  const entries: Entry[] = [];
  for (const event of events.toReversed()) {
    const line = eventLine(event, known);
    const cell = where(event);
    const above = entries.at(-1);
    if (above !== undefined && above.cell === cell && sameLine(above, event, line)) above.times += 1;
    else if (entries.length === most) break;
    else entries.push({ event, line, times: 1, cell, about: what(event) });
  }
  return entries;
}

function sameLine(above: Entry, event: LogEvent, line: Line): boolean {
  const same = above.line.text === line.text && above.line.strong === line.strong && above.line.tone === line.tone;
  return same && above.event.kind === event.kind && above.event.invocation === event.invocation;
}

/** Kinds that only repeat what another line says better; the log shows them on demand. */
const QUIET_KINDS: ReadonlySet<string> = new Set(['authorization', 'telemetry', 'principal', 'status']);

/** Whether it is left to that demand: nothing that went wrong is. */
export const quietly = (event: LogEvent): boolean => QUIET_KINDS.has(event.kind) && eventLine(event).tone === 'quiet';
