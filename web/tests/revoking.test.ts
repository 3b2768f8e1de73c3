import { describe, expect, it } from 'vitest';
import { ApiError } from '../src/lib/api/client';
import { Revoking } from '../src/lib/live/revoking.svelte';

describe('a grant that is revoked', () => {
  it('is said to be until there is an answer, and its refusal is of it alone', async () => {
    const answers: { give: () => void; fail: () => void }[] = [];
    const revoking = new Revoking({ revoke: () => new Promise((give, fail) => answers.push({ give: () => give({} as never), fail: () => fail(new Error('No answer.')) })) });
    const first = revoking.revoke('a');
    const second = revoking.revoke('b');
    expect([revoking.asked('a'), revoking.asked('b'), revoking.asked('c')]).toEqual([true, true, false]);
    answers[0]?.fail();
    await first;
    answers[1]?.give();
    await second;
    expect([revoking.asked('a'), revoking.asked('b'), revoking.refused]).toEqual([false, false, [{ id: 'a', why: ' is not revoked: No answer.' }]]);
    const again = revoking.revoke('a');
    expect([revoking.asked('a'), revoking.refused]).toEqual([true, []]);
    answers[2]?.give();
    await again;
    expect(revoking.asked('a')).toBe(false);
  });

  it('is not said to stand where no answer came', async () => {
    const unheard = new ApiError({ title: '', status: 0, code: 'unreachable', detail: 'It is not known whether this arrived.' });
    const revoking = new Revoking({ revoke: () => Promise.reject(unheard) });
    await revoking.revoke('a');
    expect(revoking.refused).toEqual([{ id: 'a', why: ': It is not known whether this arrived.' }]);
  });
});
