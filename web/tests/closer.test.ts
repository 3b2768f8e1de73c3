import { beforeEach, describe, expect, it } from 'vitest';
import { ApiError } from '../src/lib/api/client';
import type { Comparison, Shadow } from '../src/lib/api/documents';
import { Closer } from '../src/lib/policy/versions.svelte';

interface Asked<T> {
  give: (of: T) => void;
  fail: () => void;
}

const comparison = (direction: Comparison['direction']): Comparison => ({ direction, differences: [] });
const shadow = (on: boolean): Shadow => ({ digest: 'sha256:b', on, by: null, why: null, since: null, decisions: 0, differing: 0, groups: [] });

describe('what is known of a version', () => {
  let compared: Asked<Comparison>[];
  let looked: Asked<Shadow>[];
  let said: Asked<Shadow>[];
  let closer: Closer;

  function ask<T>(of: Asked<T>[]): Promise<T> {
    return new Promise((give, reject) => of.push({ give, fail: () => reject(new ApiError({ title: '', status: 0, detail: 'no answer', code: 'unreachable' })) }));
  }

  beforeEach(() => {
    [compared, looked, said] = [[], [], []];
    closer = new Closer({ comparison: () => ask(compared), shadow: () => ask(looked), setShadow: () => ask(said) }, 'sha256:b');
  });

  it('is compared with what is in force now, and with nothing that was', async () => {
    const first = closer.compare();
    compared[0]?.give(comparison('tightens'));
    await first;
    expect(closer.found?.direction).toBe('tightens');
    const gone = new AbortController();
    const second = closer.compare(gone.signal);
    expect(closer.found).toBe(null);
    gone.abort();
    const third = closer.compare();
    compared[2]?.fail();
    compared[1]?.give(comparison('same'));
    await Promise.all([second, third]);
    expect([closer.found, closer.trouble]).toEqual([null, 'No answer.']);
    const again = closer.again();
    compared[3]?.give(comparison('loosens'));
    await again;
    expect([closer.found?.direction, closer.trouble, compared.length, looked.length]).toEqual(['loosens', null, 4, 0]);
  });

  it('is in the shadow as the newest word says, whichever answer comes last', async () => {
    const early = closer.look();
    const word = closer.setShadow(true, 'why');
    const meanwhile = closer.look();
    said[0]?.give(shadow(true));
    await word;
    looked[0]?.give(shadow(false));
    looked[1]?.give(shadow(false));
    await Promise.all([early, meanwhile]);
    expect(closer.shadow?.on).toBe(true);
  });

  it('is asked once more where it could not be had', async () => {
    const [older, newer] = [closer.look(), closer.look()];
    looked[1]?.give(shadow(false));
    looked[0]?.fail();
    await Promise.all([older, newer]);
    expect([closer.shadow?.on, closer.dark]).toEqual([false, null]);
    const failing = closer.look();
    looked[2]?.fail();
    await failing;
    expect([closer.shadow?.on, closer.dark, closer.trouble]).toEqual([false, 'No answer.', null]);
    const again = closer.again();
    looked[3]?.give(shadow(true));
    await again;
    expect([closer.shadow?.on, closer.dark]).toEqual([true, null]);
  });
});
