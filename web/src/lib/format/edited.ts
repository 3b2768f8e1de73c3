import type { Escalation, InputSchema, Json } from '../api/documents';
import { labelFor, unitOf, valueOf, withUnit } from './quantity';

export interface Step {
  name: string;
  from: Json | undefined;
  to: Json | undefined;
}

/** The newest edit of a question: who made it, when, and what it changed of what was asked before it. */
export interface Edit {
  by: string;
  at: string;
  steps: Step[];
}

export function newestEdit(asked: Pick<Escalation, 'constrained' | 'effective' | 'edits'>): Edit | null {
  const edits = asked.edits ?? [];
  const last = edits.at(-1);
  if (last === undefined) return null;
  const before = edits.at(-2)?.params ?? asked.constrained ?? {};
  const steps = Object.entries(last.params).filter(([name, to]) => before[name] !== to).map(([name, to]) => ({ name, from: before[name], to }));
  return { by: last.by, at: last.at, steps };
}

/** `grip force 60 → 40 N`. */
export function stepsText(steps: readonly Step[], inputs: Record<string, InputSchema>): string {
  const said = steps.map(({ name, from, to }) => {
    const label = labelFor(name, inputs[name]);
    const before = unitOf(name) === '' ? withUnit(name, from) : valueOf(name, from);
    return `${label.charAt(0).toLowerCase()}${label.slice(1)} ${before} → ${withUnit(name, to)}`;
  });
  return said.join(', ');
}
