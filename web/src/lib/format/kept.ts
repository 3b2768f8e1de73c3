import type { LogEvent } from '../api/documents';
import type { Tone } from './status';

/** What the record says of telemetry: what could not be written, or was lost with its cell, is none that was kept. */
export function keptWords({ rows, failed, missing }: LogEvent['body']): { tone: Tone; strong: string; text: string } {
  if (typeof failed === 'string') return { tone: 'warn', strong: 'Telemetry not kept', text: `: ${failed}` };
  const text = `Telemetry kept, ${typeof rows === 'number' ? rows : 0} rows`;
  return typeof missing === 'string' ? { tone: 'warn', strong: '', text: `${text}, not whole: ${missing}` } : { tone: 'quiet', strong: '', text };
}
