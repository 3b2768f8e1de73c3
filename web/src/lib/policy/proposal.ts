import type { Asking, Capability, InputSchema, Json, Params, PolicySet } from '../api/documents';
import { entryOf } from '../format/entry';
import { labelFor, unitOf } from '../format/quantity';
import { quoted } from '../format/quoted';

/** One input of the form, made from the capability's JSON Schema. */
export interface Field {
  name: string;
  label: string;
  kind: 'number' | 'choice' | 'text' | 'flag';
  unit: string;
  required: boolean;
  /** Range and default in words. */
  hint: string;
  choices: string[];
  schema: InputSchema;
}

/** Where names that a parameter refers to stand in the site. */
const NAMED: Record<string, string> = { object: 'objects', target: 'targets', surface: 'surfaces', area: 'areas', corridor: 'corridors', tool: 'tools' };

export function fieldsOf(capability: Capability, policy: PolicySet | null, typed: Record<string, string> = {}): Field[] {
  const required = new Set(capability.inputs.required ?? []);
  return Object.entries(capability.inputs.properties ?? {}).map(([name, schema]) => {
    const choices = choicesOf(schema, policy, typed);
    const kind = schema.type === 'number' || schema.type === 'integer' ? 'number' : schema.type === 'boolean' ? 'flag' : choices.length > 0 ? 'choice' : 'text';
    return { name, label: labelFor(name, schema), kind, unit: schema.unit ?? unitOf(name), required: required.has(name), hint: hintOf(schema), choices, schema };
  });
}

function choicesOf(schema: InputSchema, policy: PolicySet | null, typed: Record<string, string>): string[] {
  if (schema.enum !== undefined) return schema.enum.map(String);
  const reference = schema['x-ref'];
  if (reference === undefined || policy === null) return [];
  if (reference === 'action') return actionsOf(policy, typed['tool']);
  return namesOf(policy.site[entryOf(NAMED, reference) ?? reference]);
}

/** What can be done with the tool that is chosen; with every tool while none is. */
function actionsOf(policy: PolicySet, tool: string | undefined): string[] {
  const tools = policy.site['tools'];
  if (tools === null || typeof tools !== 'object') return [];
  const found = Object.entries(tools as Record<string, { actions?: unknown }>)
    .filter(([name]) => tool === undefined || tool === '' || name === tool)
    .flatMap(([, facts]) => namesOf(facts.actions));
  return [...new Set(found)];
}

function namesOf(named: unknown): string[] {
  if (named === null || typeof named !== 'object') return [];
  return Object.keys(named).sort();
}

function hintOf(schema: InputSchema): string {
  const { minimum: least, maximum: most } = schema;
  const range = least !== undefined && most !== undefined ? `${least} to ${most}` : least !== undefined ? `at least ${least}` : most !== undefined ? `at most ${most}` : '';
  const usual = schema.default === undefined ? '' : `${typeof schema.default === 'object' ? JSON.stringify(schema.default) : schema.default} if left out`;
  return [range, usual].filter((text) => text !== '').join(', ');
}

export interface Reading {
  params: Params;
  /** What cannot be meant, by parameter. Ranges are the server's to judge: what would it say is the question. */
  faults: Record<string, string>;
}

/** Reads what was typed; what was left empty is left out, so that the server's defaults show. */
export function readParams(fields: readonly Field[], typed: Record<string, string>): Reading {
  const params: Params = {};
  const faults: Record<string, string> = {};
  for (const field of fields) {
    const text = (typed[field.name] ?? '').trim();
    if (text === '') {
      if (field.required) faults[field.name] = 'needed';
      continue;
    }
    const value = valueOf(field, text);
    if (value === null) faults[field.name] = 'a number, please';
    else params[field.name] = value;
  }
  return { params, faults };
}

/** A confidence from 0 to 1; null where none is stated, undefined where it is none. */
export function readConfidence(text: string): number | null | undefined {
  if (text.trim() === '') return null;
  const value = decimal(text.trim());
  return value !== null && value >= 0 && value <= 1 ? value : undefined;
}

function valueOf(field: Field, text: string): Json {
  if (field.kind === 'flag') return text === 'yes';
  if (field.kind !== 'number') return text;
  return decimal(text);
}

/** A number as people write it, and in no way that only programmers do; null where it is none. */
function decimal(text: string): number | null {
  const cleaned = text.replace(',', '.');
  return /^-?(\d+\.?\d*|\.\d+)$/.test(cleaned) ? Number(cleaned) : null;
}

/** What a verdict comes to, in a word, a tone, and a sentence that goes on from the word. */
export function verdictWords({ status, asks }: { status: string; asks?: Asking | null }): { word: string; tone: 'ok' | 'warn' | 'danger' | 'quiet'; says: string } {
  switch (status) {
    case 'allowed':
      return { word: 'Allowed.', tone: 'ok', says: 'It would be launched, with the values below.' };
    case 'awaiting_approval':
      if (asks == null) return { word: 'Asks a person.', tone: 'warn', says: 'It would wait until people approve it.' };
      return { word: 'Asks a person:', tone: 'warn', says: askedWords(asks) };
    case 'denied':
      return { word: 'Denied.', tone: 'danger', says: 'Policy forbids it.' };
    case 'rejected':
      return { word: 'Rejected.', tone: 'danger', says: 'It would not even be considered.' };
    case 'deferred':
      return { word: 'Deferred.', tone: 'quiet', says: 'Not now: the agent would have to propose it again later.' };
    default:
      return { word: `${status.replaceAll('_', ' ')}.`, tone: 'quiet', says: '' };
  }
}

/** Why people are asked, how many of them, and how long they have. */
function askedWords({ reasons, needed, within_s: withinS }: Asking): string {
  const why = reasons.map(({ message }) => quoted(message).replace(/\.$/, ''));
  return `${[...why, `${needed} approval${needed === 1 ? '' : 's'} within ${withinS} s`].join('; ')}.`;
}
