import { describe, expect, it } from 'vitest';
import type { Review } from '../src/lib/api/documents';
import { eventLine } from '../src/lib/format/events';
import { dueWords, reviewOf, waitingOf } from '../src/lib/live/reviews';
import { event } from './samples';

function review(of: Partial<Review> = {}): Review {
  return {
    id: 'rev_1', invocation: 'inv_1', status: 'waiting', capability: 'navigate_to', agent: 'planner', cell: 'workcell-1', profile: 'sim-relaxed', risk: 'low', outcome: 'stopped',
    reasons: [{ rule: 'sim-relaxed/authority', code: 'reviewed_for_outcome', message: 'what ended as `stopped` is reviewed in sim-relaxed', remedy: '' }],
    verdict: null, created_at: '2026-11-22T10:00:00.000Z', ...of,
  };
}

const known = (...all: Review[]): Record<string, Review> => Object.fromEntries(all.map((one) => [one.id, one]));

describe('the queue of reviews', () => {
  it('begins with the higher risk, then with what has waited longest', () => {
    const late = review({ id: 'rev_late', created_at: '2026-11-22T11:00:00.000Z' });
    const grave = review({ id: 'rev_grave', risk: 'high', created_at: '2026-11-22T12:00:00.000Z' });
    expect(waitingOf(known(late, review(), grave)).map((one) => one.id)).toEqual(['rev_grave', 'rev_1', 'rev_late']);
  });
  it('leaves out what has a verdict', () => {
    expect(waitingOf(known(review({ status: 'accepted' })))).toEqual([]);
  });
});

describe('the review of a session', () => {
  it('is the newest version that was told', () => {
    const told = review({ status: 'objected' });
    expect(reviewOf('inv_1', known(told), [event('review', { op: 'waiting', review: { ...review() } as never })])?.status).toBe('objected');
  });
  it('is read from the trace where nobody told of it', () => {
    expect(reviewOf('inv_1', {}, [event('review', { op: 'waiting', review: { ...review() } as never })])?.id).toBe('rev_1');
  });
  it('is none where policy asks for none', () => {
    expect(reviewOf('inv_1', known(review({ invocation: 'inv_2' })), [event('outcome', { outcome: 'succeeded' })])).toBeNull();
  });
  it('says why it is due', () => {
    expect(dueWords(review())).toBe('What ended as “stopped” is reviewed in sim-relaxed');
  });
  it('stands in the log with its verdict and note', () => {
    const verdict = { by: 'auditor', at: '', verdict: 'objected', note: 'too late' };
    const line = eventLine(event('review', { op: 'verdict', review: { outcome: 'stopped', verdict } }, 'inv_1', 'auditor'));
    expect(line.strong + line.text).toBe('auditor reviewed: objected, “too late”');
  });
});
