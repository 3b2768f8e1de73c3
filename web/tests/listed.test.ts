import { readFileSync, readdirSync } from 'node:fs';
import { join } from 'node:path';
import { describe, expect, it } from 'vitest';
import { DRIVING, GROUPS } from '../src/lib/keys/listed';

const COMPONENTS = join(import.meta.dirname, '../src/components');
const files = readdirSync(COMPONENTS, { recursive: true, encoding: 'utf8' }).filter((name) => name.endsWith('.svelte'));
const registered = files.flatMap((name) => [...readFileSync(join(COMPONENTS, name), 'utf8').matchAll(/keys\.on\('(.+?)', '(.+?)',/g)].map(([, key, says]) => `${key}: ${says}`));

describe('the list of keys', () => {
  it('holds every key that any part of the console hears, in its words', () => {
    const listed = [...GROUPS, DRIVING].flatMap(({ keys }) => keys.map(([key, says]) => `${key}: ${says}`));
    expect(registered.length).toBeGreaterThan(20);
    expect(new Set(registered)).toEqual(new Set(listed));
  });
});
