import type { ProfileFacts } from './profiles';

/** Whether a person may take the controls there; where it is not known yet, the server says so. */
export function takesOver(facts: ProfileFacts | undefined): boolean {
  return facts === undefined || (facts.authority?.modes ?? []).includes('takeover-enabled');
}
