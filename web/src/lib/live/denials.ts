import type { Escalation, PolicySet } from '../api/documents';

/** Why a person denies: the agent gets the code and policy's words for it, never the person's own. */
export interface Denial {
  code: string;
  says: string;
}

interface Declared {
  code?: unknown;
  says?: unknown;
  message?: unknown;
}

/** Returns the codes that the policy in force declares; its first is the default, of who names none. */
export function denialsOf(policy: PolicySet | null): Denial[] {
  const declared = policy?.authority?.denials;
  if (!Array.isArray(declared)) return [];
  return (declared as Declared[])
    .filter((entry) => typeof entry.code === 'string')
    .map((entry) => {
      const code = String(entry.code);
      const says = entry.says ?? entry.message;
      return { code, says: code.replaceAll('_', ' ') || String(says) };
    });
}

/** The code that fits what is asked: a question about a person in the way is most often denied for that person. Else none. */
export function likelyDenial(escalation: Escalation, denials: readonly Denial[]): string {
  const aboutPeople = escalation.reasons.some((reason) => /separation|person/.test(`${reason.rule} ${reason.code}`));
  const fitting = aboutPeople ? denials.find((denial) => denial.code === 'person_in_the_way') : undefined;
  return fitting?.code ?? '';
}

/** Whether it has to be said yet why; where policy knows of no more than one reason, there is nothing to choose. */
export function unsaid(chosen: string, denials: readonly Denial[]): boolean {
  return chosen === '' && denials.length > 1;
}

/** The code that was chosen, as long as the policy in force declares it: another one would refuse the denial with it. */
export function standingDenial(chosen: string, escalation: Escalation, denials: readonly Denial[]): string {
  return denials.length === 0 || denials.some(({ code }) => code === chosen) ? chosen : likelyDenial(escalation, denials);
}

/**
 * Whether a denial lets nothing move. It is bound to what was read, so one that restrains is sent on a link that is late or
 * down as well, as a pause is; what is undone moves.
 */
export function restrains({ on_deny }: Pick<Escalation, 'on_deny'>): boolean {
  return on_deny !== 'rollback';
}
