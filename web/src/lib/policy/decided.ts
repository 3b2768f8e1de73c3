import type { Decided, InputSchema } from '../api/documents';
import { entryOf } from '../format/entry';
import { labelFor, withUnit } from '../format/quantity';

/** A row of a decision under two versions: what it is about, and what it is by either. */
export interface DecidedRow {
  about: string;
  before: string;
  after: string;
}

const NONE = '–';

/** What becomes of one proposal under what is in force and under a candidate, row by row; what neither version says is left out. */
export function decidedRows(before: Decided, after: Decided, inputs: Record<string, InputSchema>): DecidedRow[] {
  const names = [...new Set([...Object.keys(before.values), ...Object.keys(after.values)])];
  const value = (of: Decided, name: string): string => (entryOf(of.values, name) === undefined ? NONE : withUnit(name, entryOf(of.values, name)));
  const rules = (of: Decided): string => of.rules.join(', ') || NONE;
  return [
    { about: 'Outcome', before: outcomeOf(before), after: outcomeOf(after) },
    ...names.map((name) => ({ about: labelFor(name, entryOf(inputs, name)), before: value(before, name), after: value(after, name) })),
    { about: 'By', before: rules(before), after: rules(after) },
  ];
}

function outcomeOf({ what, approvers }: Decided): string {
  if (what === 'deny') return 'denied';
  if (what === 'allow') return 'launched';
  return approvers === 1 ? 'asks one person' : `asks ${approvers} people`;
}
