import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import { ApiError } from '../src/lib/api/client';
import type { Invocation, Review, ReviewVerdict } from '../src/lib/api/documents';
import { eventLine } from '../src/lib/format/events';
import { Reviewing, type Draft } from '../src/lib/live/reviewing.svelte';
import { reviewOf } from '../src/lib/audit/reviewed';
import { dueWords, judgedOf, shownWords, tooLong, waitingOf } from '../src/lib/live/reviews';
import { Titles } from '../src/lib/live/titles.svelte';
import { event, invocation } from './samples';

function review(of: Partial<Review> = {}): Review {
  return {
    id: 'rev_1', invocation: 'inv_1', status: 'waiting', capability: 'navigate_to', agent: 'planner', cell: 'workcell-1', profile: 'sim-relaxed', risk: 'low', outcome: 'stopped',
    reasons: [{ rule: 'sim-relaxed/authority', code: 'reviewed_for_outcome', message: 'what ended as `stopped` is reviewed in sim-relaxed', remedy: '' }],
    verdict: null, created_at: '2026-11-22T10:00:00.000Z', ...of,
  };
}

function judged(verdict: ReviewVerdict, of: Partial<Review> = {}, at = '', note: string | null = null, by = 'auditor'): Review {
  return review({ ...of, status: verdict, verdict: { by, at, verdict, note } });
}

const known = (...all: Review[]): Record<string, Review> => Object.fromEntries(all.map((one) => [one.id, one]));

describe('a note on a session', () => {
  it('is told to be too long by what goes beyond what the server takes of it', () => {
    expect(tooLong(` ${'x'.repeat(4096)} `)).toBe('');
    expect(tooLong('x'.repeat(4097))).toBe('The note is 1 letter longer than the record takes.');
    expect(tooLong('😀'.repeat(4096))).toBe('');
    expect(tooLong('x'.repeat(5000))).toBe('The note is 904 letters longer than the record takes.');
  });
});

describe('the queue of reviews', () => {
  it('begins with the higher risk, then with what has waited longest', () => {
    const late = review({ id: 'rev_late', created_at: '2026-11-22T11:00:00.000Z' });
    const grave = review({ id: 'rev_grave', risk: 'high', created_at: '2026-11-22T12:00:00.000Z' });
    expect(waitingOf(known(late, review(), grave)).map((one) => one.id)).toEqual(['rev_grave', 'rev_1', 'rev_late']);
  });
  it('leaves out what has a verdict', () => {
    expect(waitingOf(known(review({ status: 'accepted' })))).toEqual([]);
  });
  it('says how much of it is shown, where that is not all', () => {
    expect([shownWords(100, 117), shownWords(13, 13)]).toEqual(['100 of 117 shown; the rest follow as these are judged.', '']);
  });
  it('ends with the verdicts, the newest first', () => {
    expect(judgedOf([judged('accepted', { id: 'a' }, '10'), review({ id: 'b' }), judged('objected', { id: 'c' }, '11')]).map((one) => one.id)).toEqual(['c', 'a']);
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

describe('a verdict in the making', () => {
  const A = review({ id: 'rev_a', invocation: 'inv_a' });
  const B = review({ id: 'rev_b', invocation: 'inv_b' });
  let answers: { give: (closed: Review) => void; fail: (code: string) => void }[];
  let record: Record<string, Review>;
  let down: boolean;
  let asked: string[];
  let forgotten: boolean;
  let reviewing: Reviewing;

  const refusal = (code: string): ApiError => new ApiError({ title: '', status: 0, detail: code, code });
  const written = (one: Review, verdict: ReviewVerdict, note: string): Draft => Object.assign(reviewing.of(one), { verdict, note });

  beforeEach(() => {
    vi.useFakeTimers({ now: 0 });
    [answers, record, down, asked, forgotten] = [[], {}, false, [], false];
    reviewing = new Reviewing(
      {
        review: () => new Promise<Review>((resolve, reject) => answers.push({ give: resolve, fail: (code) => reject(refusal(code)) })),
        reviewsOf: (session) => {
          asked.push(session);
          return down ? Promise.reject(refusal('unreachable')) : Promise.resolve({ items: Object.values(record).filter((one) => one.invocation === session), next: null });
        },
      },
      () => 'operator',
      (one) => (forgotten ? 'Grasp object' : one.id),
    );
    reviewing.resume(known(A, B));
  });
  afterEach(() => {
    reviewing.end();
    vi.useRealTimers();
  });

  it('closes its own form alone, however late the answer comes', async () => {
    reviewing.toggle(A);
    const sending = reviewing.send(written(A, 'accepted', ''));
    reviewing.toggle(B);
    const other = written(B, 'objected', 'half a sentence');
    answers[0]?.give(judged('accepted', A));
    expect(await sending).toBe(true);
    expect([reviewing.open, reviewing.of(B) === other, other.note]).toEqual(['rev_b', true, 'half a sentence']);
    expect(reviewing.told).toBe('rev_a: Recorded: accepted.');
    const next = reviewing.send(other);
    answers[1]?.give(judged('objected', B));
    await next;
    expect([reviewing.open, reviewing.told]).toEqual([null, 'Recorded: objected.']);
  });

  it('is told of by what it was about when it was sent, though the console knows that no more', async () => {
    const sending = reviewing.send(written(A, 'accepted', ''));
    forgotten = true;
    answers[0]?.give(judged('accepted', A));
    await sending;
    expect(reviewing.told).toBe('rev_a: Recorded: accepted.');
  });

  it('is named by what it is about as long as its note is not sent', async () => {
    written(A, 'accepted', ' ');
    expect(reviewing.unsent).toEqual([]);
    const sending = reviewing.send(written(A, 'accepted', 'all well'));
    written(B, 'objected', 'half a sentence');
    expect(reviewing.unsent).toEqual(['rev_b']);
    answers[0]?.fail('unreachable');
    await sending;
    expect(reviewing.unsent).toEqual(['rev_a', 'rev_b']);
  });

  it('is kept as long as its review waits, whether a form shows it or not', () => {
    const gone = reviewing.keep(written(A, 'accepted', 'kept'));
    const empty = reviewing.keep(reviewing.of(B));
    const before = reviewing.of(B);
    [gone, empty].forEach((leave) => leave());
    expect([reviewing.of(A).verdict, reviewing.of(A).note, reviewing.of(B) === before]).toEqual(['accepted', 'kept', false]);
    reviewing.follow(known(judged('accepted', A), B));
    expect(reviewing.of(A).note).toBe('');
  });

  it('leaves its note to be read where somebody else was first', () => {
    reviewing.toggle(A);
    written(A, 'accepted', ' too late ');
    const closed = judged('objected', A);
    reviewing.follow(known(closed, B));
    expect([reviewing.open, reviewing.told, reviewing.left]).toEqual([null, 'auditor reviewed it: objected.', [{ review: closed, title: 'rev_a', note: 'too late' }]]);
    reviewing.putAway('rev_a');
    expect(reviewing.left).toEqual([]);
  });

  it('asks what became of it where a new link does not tell, until there is an answer', async () => {
    reviewing.toggle(A);
    written(A, 'accepted', 'typed');
    down = true;
    record = known(judged('objected', A));
    reviewing.resume(known(B));
    await vi.advanceTimersByTimeAsync(10);
    expect([reviewing.open, reviewing.opened?.id, reviewing.of(A).note]).toEqual(['rev_a', 'rev_a', 'typed']);
    down = false;
    await vi.advanceTimersByTimeAsync(5_000);
    expect([reviewing.open, reviewing.told, reviewing.left[0]?.note]).toEqual([null, 'auditor reviewed it: objected.', 'typed']);
    expect(asked).toEqual(['inv_a', 'inv_a']);
  });

  it('stays open where its review waits on, though graver ones took its place', async () => {
    reviewing.toggle(A);
    record = known(A);
    reviewing.resume(known(B));
    await vi.advanceTimersByTimeAsync(10);
    expect([reviewing.opened?.id, reviewing.told]).toEqual(['rev_a', '']);
  });

  it('may have been recorded where no answer came, and says so', async () => {
    reviewing.toggle(A);
    const draft = written(A, 'accepted', 'mine');
    const sending = reviewing.send(draft);
    const mine = judged('accepted', A, '', 'mine', 'operator');
    reviewing.follow(known(mine, B)); // heard before the answer: that is what the form goes by
    expect([reviewing.open, draft.sending]).toEqual(['rev_a', true]);
    reviewing.follow(known(A, B));
    answers[0]?.fail('unreachable');
    expect(await sending).toBe(false);
    expect([draft.problem, draft.sending]).toEqual(['No answer from the server: it is not known whether your verdict was recorded.', false]);
    reviewing.follow(known(mine, B));
    expect([reviewing.told, reviewing.left]).toEqual(['You reviewed it: accepted.', []]);
  });

  it('is told of where it was refused and no form shows it', async () => {
    reviewing.toggle(A);
    const sending = reviewing.send(written(A, 'accepted', 'late'));
    reviewing.toggle(B);
    reviewing.follow(known(judged('objected', A), B));
    answers[0]?.fail('already_reviewed');
    await sending;
    expect([reviewing.open, reviewing.told]).toEqual(['rev_b', 'rev_a: Somebody has given a verdict already; yours is not recorded.']);
    expect(reviewing.left.map(({ note }) => note)).toEqual(['late']);
  });
});

describe('what a review was about', () => {
  const old = Array.from({ length: 5 }, (_, k) => review({ id: `rev_${k}`, invocation: `inv_${k}`, capability: 'grasp_object' }));
  const session = (id: string): Invocation => invocation({ id, effective: { object_id: `mug_of_${id}` } });

  it('is asked for where it is not known, a few at a time, and remembered', async () => {
    let [now, most] = [0, 0];
    const asked: string[] = [];
    const titles = new Titles({
      invocation: async (id) => {
        asked.push(id);
        most = Math.max(most, (now += 1));
        await Promise.resolve();
        now -= 1;
        return session(id);
      },
    });
    const told = { inv_0: session('inv_0') };
    titles.want(old, told);
    await vi.waitFor(() => expect(titles.of(old[4] as Review)).toBe('Grasp mug_of_inv_4'));
    titles.want(old, {}); // the console keeps none of them any more
    expect([titles.of(old[0] as Review), asked, most]).toEqual(['Grasp mug_of_inv_0', ['inv_1', 'inv_2', 'inv_3', 'inv_4'], 2]);
    titles.want([], {});
    expect(titles.of(old[0] as Review)).toBe('Grasp object');
  });

  it('is not asked for again where there is no answer to it, and is where there was no server', async () => {
    let code = 'unreachable';
    const asked: string[] = [];
    const titles = new Titles({
      invocation: (id) => {
        asked.push(id);
        return Promise.reject(new ApiError({ title: '', status: 0, detail: '', code }));
      },
    });
    const settled = (): Promise<void> => new Promise((resolve) => setTimeout(resolve));
    titles.want(old.slice(0, 1), {});
    await settled();
    code = 'invocation_unknown';
    for (let turn = 0; turn < 2; turn += 1) {
      titles.want(old.slice(0, 1), {});
      await settled();
    }
    expect([asked, titles.of(old[0] as Review)]).toEqual([['inv_0', 'inv_0'], 'Grasp object']);
  });
});
