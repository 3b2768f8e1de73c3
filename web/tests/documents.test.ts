import { describe, expect, it } from 'vitest';
import type { Grant, Review } from '../src/lib/api/documents';
import { EVENTS_KEPT, INVOCATIONS_KEPT, merged, NOTHING, VERDICTS_KEPT, WAITING_KEPT, type Documents } from '../src/lib/state/documents';
import { cell, escalation, event, invocation } from './samples';

const at = (second: number): string => new Date(Date.parse('2026-11-22T10:00:00Z') + second * 1000).toISOString();

function grant(of: Partial<Grant>): Grant {
  return {
    id: 'grant_1', status: 'active', capability: 'grasp_object', agent: 'planner', cell: 'workcell-1', profile: 'human-shared', scope: 'object',
    object: 'mug_1', task: null, issued_by: 'operator', expires_at: at(900), uses: 0, ...of,
  };
}

function review(of: Partial<Review>): Review {
  return {
    id: 'rev_1', invocation: 'inv_1', status: 'waiting', capability: 'navigate_to', agent: 'planner', cell: 'workcell-1', profile: 'sim-relaxed',
    risk: 'low', outcome: 'stopped', reasons: [], verdict: null, created_at: at(0), ...of,
  };
}

/** A shift: one session after the other, each with a question, a grant, a review and what is written of it. */
function shift(sessions: number, known: Documents = NOTHING): Documents {
  for (let k = 0; k < sessions; k += 1) {
    const created_at = at(k);
    const judged = { status: 'accepted', verdict: { by: 'operator', at: at(k + 9), verdict: 'accepted', note: null } } as const;
    const events = Array.from({ length: 9 }, () => event('alert', { rule: 'separation' }, `inv_${k}`));
    for (const over of [false, true]) {
      known = merged(known, {
        seq: known.seq + 1,
        cells: [cell({ busy: over ? null : `inv_${k}` })],
        invocations: [invocation({ id: `inv_${k}`, created_at, ...(over ? { status: 'completed', outcome: 'succeeded' } : {}) })],
        escalations: [escalation({ id: `esc_${k}`, status: over ? 'approved' : 'pending' })],
        grants: [grant({ id: `grant_${k}`, status: over ? 'ended' : 'active' })],
        reviews: [review({ id: `rev_${k}`, invocation: `inv_${k}`, created_at, ...(over ? judged : {}) })],
        events: over ? events : [],
      });
    }
  }
  return known;
}

const count = (all: object): number => Object.keys(all).length;

describe('a cell', () => {
  it('is known until the server says that it is gone', () => {
    const before = merged(NOTHING, { seq: 1, cells: [cell(), cell({ id: 'workcell-2' })] });
    expect(Object.keys(merged(before, { seq: 1, cells: [cell({ id: 'workcell-3' })], cells_gone: ['workcell-1'] }).cells)).toEqual(['workcell-2', 'workcell-3']);
  });
});

describe('what a console keeps over a shift', () => {
  const known = shift(300);

  it('is bounded, whatever went through it', () => {
    expect(known.events.length).toBe(EVENTS_KEPT);
    expect([known.cells, known.invocations, known.escalations, known.grants, known.reviews].map(count)).toEqual([1, INVOCATIONS_KEPT, 0, 0, VERDICTS_KEPT]);
  });

  it('is the newest', () => {
    expect(known.events.at(-1)?.invocation).toBe('inv_299');
    expect([known.invocations['inv_299'], known.reviews['rev_299']]).not.toContain(undefined);
    expect([known.invocations['inv_0'], known.reviews['rev_0']]).toEqual([undefined, undefined]);
  });

  it('holds a session that runs, and a review that waits, whatever comes after them', () => {
    const before = merged(NOTHING, {
      seq: 1, invocations: [invocation({ id: 'runs', status: 'escalated', created_at: at(-9) })], reviews: [review({ id: 'waits', created_at: at(-9) })],
      grants: [grant({ id: 'stands' })],
    });
    const after = shift(300, before);
    expect([after.invocations['runs']?.status, after.reviews['waits']?.status, after.grants['stands']?.status]).toEqual(['escalated', 'waiting', 'active']);
  });

  it('is the reviews that are judged first, and how many wait in all', () => {
    const many = Array.from({ length: WAITING_KEPT + 7 }, (_, k) => review({ id: `rev_${k}`, created_at: at(k), ...(k === WAITING_KEPT + 6 ? { risk: 'high' } : {}) }));
    const kept = many.reduce((before, one, k) => merged(before, { seq: k, reviews: [one], reviews_waiting: k + 1 }), NOTHING);
    expect([count(kept.reviews), kept.reviewsWaiting]).toEqual([WAITING_KEPT, WAITING_KEPT + 7]);
    expect([`rev_${WAITING_KEPT + 6}`, 'rev_0', `rev_${WAITING_KEPT - 1}`].map((id) => id in kept.reviews)).toEqual([true, true, false]);
    expect(merged(kept, { seq: 999 }).reviewsWaiting).toBe(WAITING_KEPT + 7);
  });

  it('is the same value as before where nothing was said of it', () => {
    const open = { invocations: [invocation({ id: 'runs' })], grants: [grant({ id: 'stands' })], reviews: [review({ id: 'waits' })] };
    const before = merged(known, { seq: 601, ...open });
    const next = merged(before, { seq: 602, events: [event('boot', {})] });
    expect([next.invocations === before.invocations, next.grants === before.grants, next.reviews === before.reviews]).toEqual([true, true, true]);
  });
});
