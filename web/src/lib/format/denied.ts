import type { Json } from '../api/documents';

/** A denial as a question's document keeps it, with its reason in policy's words where one was chosen. */
export function deniedWords(denial: Json | undefined): string {
  if (typeof denial !== 'object' || denial === null || Array.isArray(denial)) return 'denied';
  const { code, says } = denial;
  return code === 'unspecified' || typeof says !== 'string' || says === '' ? 'denied' : `denied: ${says}`;
}
