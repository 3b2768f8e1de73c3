import type { Json, LogEvent, Review } from '../api/documents';

/** The review of a session: the newest version that is known, or else the one that its trace ends with. */
export function reviewOf(invocation: string, known: Readonly<Record<string, Review>>, trace: readonly LogEvent[]): Review | null {
  const told = Object.values(known).find((review) => review.invocation === invocation);
  if (told !== undefined) return told;
  const recorded: Json | undefined = trace.findLast((event) => event.kind === 'review')?.body['review'];
  return recorded === null || typeof recorded !== 'object' ? null : (recorded as unknown as Review);
}
