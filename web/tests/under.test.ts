import { describe, expect, it } from 'vitest';
import { keptWords, profileIn } from '../src/lib/live/under';
import { cell, invocation } from './samples';

describe('what runs', () => {
  const session = invocation({ id: 'inv_1', profile: 'real-restricted' });

  it('keeps the profile that it was launched under, and an idle cell is under its own', () => {
    expect(profileIn(cell({ busy: 'inv_1', profile: 'human-shared' }), session)).toBe('real-restricted');
    expect([null, 'inv_2'].map((busy) => profileIn(cell({ busy, profile: 'human-shared' }), session))).toEqual(['human-shared', 'human-shared']);
    expect(profileIn(cell({ busy: 'inv_1', profile: 'human-shared' }), null)).toBe('human-shared');
  });

  it('says so where its cell is under another one by now', () => {
    const said = (busy: string | null, profile: string): string => keptWords(cell({ busy, profile }), session);
    expect(said('inv_1', 'human-shared')).toBe('Launched under real-restricted, it keeps that: human-shared holds for what comes next.');
    expect([said('inv_1', 'real-restricted'), said(null, 'human-shared')]).toEqual(['', '']);
  });
});
