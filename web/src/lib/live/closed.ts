import type { LogEvent } from '../api/documents';
import { eventLine } from '../format/events';

/** How a question ended that is not open any more, as the record says it. */
export function closedWords(events: readonly LogEvent[], question: string): string {
  const about = (event: LogEvent): boolean => {
    const asked = event.body['escalation'];
    return typeof asked === 'object' && asked !== null && 'id' in asked && asked.id === question && 'status' in asked && asked.status !== 'pending';
  };
  const last = events.findLast(about);
  if (last === undefined) return 'It is over.';
  const { strong, text } = eventLine(last);
  return `${strong}${text}.`;
}
