import type { Escalation, InputSchema, Json, LogEvent } from '../api/documents';
import { entryOf } from './entry';
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
  const steps = Object.entries(last.params).filter(([name, to]) => entryOf(before, name) !== to).map(([name, to]) => ({ name, from: entryOf(before, name), to }));
  return { by: last.by, at: last.at, steps };
}

/** `grip force 60 → 40 N`. */
export function stepsText(steps: readonly Step[], inputs: Record<string, InputSchema>): string {
  const said = steps.map(({ name, from, to }) => {
    const label = labelFor(name, entryOf(inputs, name));
    const before = unitOf(name) === '' ? withUnit(name, from) : valueOf(name, from);
    return `${label.charAt(0).toLowerCase()}${label.slice(1)} ${before} → ${withUnit(name, to)}`;
  });
  return said.join(', ');
}

/** What stands of an edit: nothing where it came to what was asked before, or where policy was renewed since. */
export function standingEdit(asked: Escalation): Edit | null {
  const edit = newestEdit(asked);
  const stands = edit !== null && edit.steps.length > 0 && asked.edits?.at(-1)?.digest === asked.digest;
  return stands ? edit : null;
}

/** Whether somebody's own approval counts no more: it was of what was asked before another's edit, or before the world, its policy or its profile changed. */
export function voidedOf(asked: Escalation, events: readonly LogEvent[], me: string | null): boolean {
  if (standingEdit(asked)?.by === me) return false;
  if (asked.approvals.some((approval) => approval.by === me)) return false;
  return events.some(({ kind, actor, body }) => {
    const of = body['escalation'] as Partial<Escalation> | undefined;
    return kind === 'approval' && actor === me && body['decision'] === 'approve' && of?.id === asked.id && of.digest !== asked.digest;
  });
}

/** Why what is asked is not what it was, in words. */
export function changedWords({ renewed }: Pick<Escalation, 'renewed'>): string {
  if (renewed === 'profile_changed') return 'The cell was put under another profile, and this is asked anew.';
  return renewed === 'policy_changed' ? 'Another policy is in force, and this is asked anew.' : 'What is asked has changed since it came.';
}
