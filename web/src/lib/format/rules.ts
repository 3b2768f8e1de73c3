import { words } from './capability';
import { entryOf } from './entry';

/** Rules of the watcher in words; others speak by their name. */
const RULES: Record<string, string> = {
  'contact-force': 'Contact force',
  'grip-force': 'Grip force',
  'tcp-speed': 'Tool speed',
  'base-speed': 'Base speed',
  zone: 'Zone margin',
  'external-torque': 'External torque',
  slip: 'Slip',
  'grip-lost': 'Grip lost',
  stall: 'No progress',
  timeout: 'Time limit',
  stale: 'Sensor stale',
  implausible: 'Sensor implausible',
  postcondition: 'Result not verified',
  'watch/completion': 'Completion',
};

export function ruleWords(rule: string): string {
  if (isNearness(rule)) return 'Separation';
  return entryOf(RULES, rule) ?? words(rule.replace(/^.*\//, '').replaceAll('-', '_'));
}

/** Whether a rule is about people who are too near: by what shipped profiles, and those from templates, call it. */
export const isNearness = (rule: unknown): boolean => typeof rule === 'string' && /^(?:.*\/)?(?:separation|people|protective-separation)$/.test(rule);
