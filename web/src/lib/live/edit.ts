import { ApiError, type Api } from '../api/client';
import type { Escalation, InputSchema, Json, Params, Reason, Verdict } from '../api/documents';
import { entryOf } from '../format/entry';

/** What an approver typed, by parameter; untouched parameters are absent. */
export type Typed = Record<string, string>;

export interface Row {
  name: string;
  requested: Json | undefined;
  effective: Json | undefined;
  editable: boolean;
}

/**
 * One row per parameter, those with numbers first, then as the capability lists them: in which order a document has
 * them changes with where it was kept. A session under way cannot be edited.
 */
export function rowsOf(escalation: Escalation, listed: readonly string[] = []): Row[] {
  const names = [...new Set([...Object.keys(escalation.effective), ...Object.keys(escalation.requested)])];
  const allowed = escalation.constrained ?? escalation.effective;
  const rows = names.map((name) => ({
    name,
    requested: entryOf(escalation.requested, name),
    effective: entryOf(allowed, name),
    editable: escalation.kind === 'approval' && typeof entryOf(escalation.effective, name) === 'number',
  }));
  const place = (name: string): number => (listed.includes(name) ? listed.indexOf(name) : listed.length);
  return rows.sort((a, b) => Number(b.editable) - Number(a.editable) || place(a.name) - place(b.name) || a.name.localeCompare(b.name));
}

export interface Edited {
  /** Only what differs from what is asked. */
  params: Params;
  /** Words on what was typed and cannot be meant, by parameter. */
  faults: Record<string, string>;
}

/** Reads what was typed against what is asked and the capability's schema. */
export function readEdit(typed: Typed, effective: Params, schema: Record<string, InputSchema>): Edited {
  const params: Params = {};
  const faults: Record<string, string> = {};
  for (const [name, text] of Object.entries(typed)) {
    const value = readNumber(text);
    const fault = value === null ? 'a number, please' : outOfRange(value, entryOf(schema, name));
    if (fault !== null) faults[name] = fault;
    else if (value !== null && value !== entryOf(effective, name)) params[name] = value;
  }
  return { params, faults };
}

function readNumber(text: string): number | null {
  const cleaned = text.trim().replace(',', '.');
  if (!/^-?(\d+\.?\d*|\.\d+)$/.test(cleaned)) return null;
  const value = Number(cleaned);
  return Number.isFinite(value) ? value : null;
}

function outOfRange(value: number, schema: InputSchema | undefined): string | null {
  if (schema?.minimum !== undefined && value < schema.minimum) return `at least ${schema.minimum}, whatever policy allows`;
  if (schema?.maximum !== undefined && value > schema.maximum) return `at most ${schema.maximum}, whatever policy allows`;
  return null;
}

export type Check =
  | { is: 'untouched' }
  | { is: 'faulty' }
  | { is: 'checking' }
  | { is: 'allowed' }
  | { is: 'cut'; to: Params }
  /** The edit was sent, and policy gave back what was asked before; `read` once there was time to see it. */
  | { is: 'given back'; to: Params; read: boolean }
  | { is: 'refused'; reasons: Reason[] }
  | { is: 'unchecked'; why: string };

/** What a verdict on the edited proposal means to the person who edited it. */
export function checkOf(verdict: Verdict, wanted: Params): Check {
  if (verdict.status === 'denied' || verdict.status === 'rejected') {
    return { is: 'refused', reasons: [...verdict.admission.reasons, ...(verdict.policy?.reasons ?? [])] };
  }
  const effective = verdict.effective ?? wanted;
  const cut = Object.entries(effective).filter(([name, value]) => Object.hasOwn(wanted, name) && wanted[name] !== value);
  return cut.length === 0 ? { is: 'allowed' } : { is: 'cut', to: Object.fromEntries(cut) };
}

/** What an agent says of a proposal beside its parameters. */
const TERMS = ['mode', 'metadata', 'preconditions', 'recovery_preference', 'capability_version'];

/** What it said with this one, as the record has it: an edit of it is decided under the same. */
async function termsOf(api: Pick<Api, 'events'>, invocation: string): Promise<Params> {
  const { items } = await api.events(new URLSearchParams({ invocation, kind: 'proposal' }));
  return Object.fromEntries(Object.entries(items[0]?.body ?? {}).filter(([name]) => TERMS.includes(name)));
}

/** Asks the server what policy would make of the edited proposal. Whatever goes wrong, the server checks once more on approval. */
export async function checkEdit(api: Pick<Api, 'check' | 'events'>, escalation: Escalation, edit: Params, cell: string | null): Promise<Check> {
  const params = { ...escalation.effective, ...edit };
  try {
    const terms = await termsOf(api, escalation.invocation);
    return checkOf(await api.check({ ...terms, capability: escalation.capability, params, cell, agent: escalation.agent }), params);
  } catch (error) {
    if (error instanceof ApiError && error.code === 'params_invalid') {
      return { is: 'refused', reasons: [{ rule: 'schema', code: error.code, message: error.message, remedy: '' }] };
    }
    return { is: 'unchecked', why: error instanceof ApiError ? error.message : String(error) };
  }
}

/** Whether `approve` may be pressed. */
export function mayApprove(check: Check): boolean {
  if (check.is === 'given back') return check.read;
  return check.is === 'untouched' || check.is === 'allowed' || check.is === 'cut' || check.is === 'unchecked';
}
