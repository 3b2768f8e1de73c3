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

/** In which unit the shipped rules measure. */
const UNITS: Record<string, string> = {
  'contact-force': 'N',
  'grip-force': 'N',
  'tcp-speed': 'm/s',
  'base-speed': 'm/s',
  zone: 'm',
  'external-torque': 'N·m',
  tracking: 'rad',
  'base-tracking': 'm/s',
  slip: 'm',
  stall: 's',
  timeout: 's',
  stale: 'ms',
};
const DIGITS = [2, 3, 4];

export function ruleWords(rule: string): string {
  if (isNearness(rule)) return 'Separation';
  return entryOf(RULES, rule) ?? words(rule.replace(/^.*\//, '').replaceAll('-', '_'));
}

/** Whether a rule is about people who are too near: by what shipped profiles, and those from templates, call it. */
export const isNearness = (rule: unknown): boolean => typeof rule === 'string' && /^(?:.*\/)?(?:separation|people|protective-separation)$/.test(rule);

/** What a rule read and what its limit is, with as many digits as tell them apart. */
export function reading(rule: string, value: number | null, limit: number | null): string {
  if (value === null) return '';
  const unit = isNearness(rule) ? 'm' : entryOf(UNITS, rule);
  const digits = DIGITS.find((some) => limit === null || rounded(value, some) !== rounded(limit, some)) ?? Math.max(...DIGITS);
  const said = [value, ...(limit === null ? [] : [limit])].map((one) => `${rounded(one, digits)}${unit === undefined ? '' : ` ${unit}`}`);
  return ` ${said.join(', limit ')}`;
}

/** Nothing is less than zero that is shown as zero. */
function rounded(value: number, digits: number): string {
  return (Number(value.toFixed(digits)) || 0).toFixed(digits);
}
