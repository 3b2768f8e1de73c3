import { UNSEEN } from './plain';

/** A document as it was recorded, where such characters stand as JSON escapes them: nothing is lost, and nothing turns around. */
export function recorded(document: unknown): string {
  const escaped = (unit: string): string => `\\u${unit.charCodeAt(0).toString(16).padStart(4, '0')}`;
  return JSON.stringify(document, null, 2).replace(UNSEEN, (characters) => characters.split('').map(escaped).join(''));
}
