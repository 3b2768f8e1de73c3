import type { Escalation, InputSchema, Invocation, Reason } from '../api/documents';
import { entryOf } from '../format/entry';
import { isNearness, ruleWords } from '../format/rules';
import { plain } from '../format/plain';
import { labelFor } from '../format/quantity';

type Inputs = Record<string, InputSchema>;

export interface ReasonLine {
  icon: 'person' | 'scale' | 'hand';
  strong: string;
  text: string;
  rule: string;
}

/** Why a held session asks, by the code the cell gives. */
const HELD: Record<string, string> = {
  stale: 'A sensor has gone silent.',
  implausible: 'A sensor says what cannot be.',
  retries: 'The tries that policy allows are used up.',
  control_lapsed: 'Whoever drove by hand fell silent.',
  link: 'The link to the cell broke off for a while.',
  stall: 'It makes no headway.',
  timeout: 'It takes longer than policy allows.',
  zone: 'A forbidden zone is too near.',
  'grip-lost': 'What it held is lost.',
  rollback_failed: 'It could not be undone and verified.',
  rollback_unavailable: 'It cannot be rolled back: there is nothing to go back to, or it was tried already.',
};

/** Before which phase a person is to confirm it, as the cell says it. */
const CONFIRM = /^confirm:(.+)$/;

const TOO_NEAR = 'A person stayed inside the protective distance, or at its edge.';

function heldWords(code: string): string {
  if (isNearness(code)) return TOO_NEAR;
  const phase = CONFIRM.exec(code)?.[1];
  return phase === undefined ? (entryOf(HELD, code) ?? '') : `Policy wants a person to confirm “${plain(phase)}” before it begins.`;
}

/** Of a limit, where its number is from: that is left to the rule. Whatever else stands in brackets is why a person is asked. */
const SOURCE = / \([^()]*\)$/;

function lineOf(reason: Reason, held: boolean, inputs: Inputs): ReasonLine {
  const icon = isNearness(reason.code) || /separation|person/.test(reason.rule) ? 'person' : held ? 'hand' : 'scale';
  const strong = held ? heldWords(reason.code) : '';
  const message = reason.code === 'limit' ? reason.message.replace(SOURCE, '') : reason.message;
  const said = strong === '' ? sentence(message, inputs) : 'The robot holds where it is and waits.';
  // What a person may say is worth a sentence only where a person is asked what becomes of a session.
  const text = held && reason.remedy !== '' ? `${said} ${sentence(reason.remedy, inputs)}` : said;
  return { icon, strong, text, rule: reason.rule.replaceAll('/', ' / ') };
}

/** Policy's words as a sentence: names in backticks become labels. */
function sentence(said: string, inputs: Inputs): string {
  const text = plain(said).replace(/`([a-z_0-9]+)`/g, (_, name: string) => (/_(n|mps|m|s|kg|rad|ms)$/.test(name) ? labelFor(name, entryOf(inputs, name)) : name));
  const upper = text.charAt(0).toUpperCase() + text.slice(1);
  return /[.!?]$/.test(upper) ? upper : `${upper}.`;
}

/** Why a person is asked, the question's own reasons first, then the rules that cut a value. */
export function reasonLines(escalation: Escalation, invocation: Invocation | null, inputs: Inputs = {}): ReasonLine[] {
  const held = escalation.kind !== 'approval';
  const asked = escalation.reasons.map((reason) => lineOf(reason, held, inputs));
  const known = new Set(escalation.reasons.map((reason) => reason.rule));
  const cuts = (held ? [] : (invocation?.policy?.reasons ?? [])).filter((reason) => !known.has(reason.rule));
  const lines = [...asked, ...cuts.map((reason) => lineOf(reason, false, inputs))];
  const worded = lines.map((line) => (line.text === '' ? { ...line, text: ruleWords(line.rule) } : line));
  return [...new Map(worded.map((line) => [line.rule + line.text, line])).values()]; // said twice, it says no more
}
