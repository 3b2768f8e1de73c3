import { describe, expect, it } from 'vitest';
import { Unheeded } from '../src/lib/live/unheeded.svelte';

describe('an answer that did not count', () => {
  const asked = (id: string): { id: string; invocation: string; title: string } => ({ id, invocation: `inv_${id}`, title: id });

  it('is told until whoever gave it knows, or answers that question again', () => {
    const unheeded = new Unheeded();
    unheeded.take(asked('a'), 'No answer.', false);
    unheeded.take(asked('b'), 'Too late.', true);
    unheeded.take(asked('c'), '', false); // of others it says nothing
    expect([unheeded.of('a'), unheeded.of('b'), unheeded.of('c')]).toEqual(['No answer.', 'Too late.', '']);
    unheeded.take(asked('a'), '', false);
    expect(unheeded.news.map(({ id }) => id)).toEqual(['b']);
    unheeded.putAway('b');
    expect(unheeded.news).toEqual([]);
  });
});
