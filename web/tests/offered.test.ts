import { describe, expect, it, vi } from 'vitest';
import { ApiError } from '../src/lib/api/client';
import { Decision } from '../src/lib/live/decision.svelte';
import { escalation } from './samples';

const turnedDown = (problem: ApiError['problem']): Decision => {
  const api = { check: vi.fn(), events: vi.fn(), resolve: () => Promise.reject(new ApiError(problem)) };
  return new Decision(api, escalation(), () => ({ schema: {}, cell: null }));
};

describe('a grant that does not fit', () => {
  it('is told with its field and the way out', async () => {
    const problem = { title: '', status: 422, code: 'params_invalid', detail: '`task` goes with the scope `task`', errors: [{ field: 'task', message: 'goes with the scope `task`' }] };
    const decision = turnedDown(problem);
    decision.offer = { scope: 'task', minutes: 5 };
    await decision.approve();
    expect(decision.problem).toBe('What is to be allowed in advance does not fit (“task”): “task” goes with the scope “task”. Choose “ask me again next time” to approve only this.');
    decision.offer = null;
    await decision.approve();
    expect(decision.problem).toBe('“task” goes with the scope “task”.');
  });

  it('is told why it does not go as things stand, with the way out', async () => {
    const reason = { rule: 'authority/grants', code: 'too_long', message: '`minutes` `15` is longer than policy allows', remedy: 'at most 10' };
    const decision = turnedDown({ title: '', status: 409, code: 'grant_refused', detail: '', reasons: [reason] });
    decision.offer = { scope: 'time', minutes: 15 };
    await decision.approve();
    expect(decision.problem).toBe('This cannot be allowed in advance: “minutes” “15” is longer than policy allows. Choose “ask me again next time” to approve only this.');
  });

  it('goes with the question that it was chosen for, and not with what is asked in its place', () => {
    const decision = turnedDown({ title: '', status: 409, code: 'grant_refused', detail: '' });
    decision.offer = { scope: 'time', minutes: 15 };
    decision.update(escalation({ acknowledged: [] }));
    expect(decision.approves).toBe('Approve and allow for 15 min');
    decision.update(escalation({ digest: 'sha256:other' }));
    expect([decision.offer, decision.approves]).toEqual([null, 'Approve']);
  });
});
