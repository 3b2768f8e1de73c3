import { describe, expect, it } from 'vitest';
import { profileIn } from '../src/lib/live/under';
import { cell, invocation } from './samples';

describe('what runs', () => {
  const session = invocation({ id: 'inv_1', profile: 'real-restricted' });

  it('keeps the profile that it was launched under, and an idle cell is under its own', () => {
    expect(profileIn(cell({ busy: 'inv_1', profile: 'human-shared' }), session)).toBe('real-restricted');
    expect([null, 'inv_2'].map((busy) => profileIn(cell({ busy, profile: 'human-shared' }), session))).toEqual(['human-shared', 'human-shared']);
    expect(profileIn(cell({ busy: 'inv_1', profile: 'human-shared' }), null)).toBe('human-shared');
  });
});
