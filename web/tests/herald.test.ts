import { describe, expect, it } from 'vitest';
import type { Escalation } from '../src/lib/api/documents';
import { Herald, TOGETHER_MS } from '../src/lib/live/herald';
import { awaited } from '../src/lib/live/stages';
import { nextOf, outstandingOf, questionsWords, soonestOf, tabTitle } from '../src/lib/live/urgency';
import { escalation } from './samples';

const asked = (...names: string[]) => names.map((name) => escalation({ id: name, effective: { object_id: name } }));

describe('new questions are announced', () => {
  it('not if they waited before anybody listened', () => {
    const herald = new Herald();
    herald.take(asked('mug_1'));
    expect(herald.dueInMs(0)).toBeNull();
    expect(herald.speak(0)).toBeNull();
  });

  it('at once and in full when one comes alone', () => {
    const herald = new Herald();
    herald.take([]);
    herald.take(asked('mug_1'));
    expect(herald.speak(0)).toBe('Waiting for you: Grasp mug_1, medium risk.');
    expect(herald.speak(TOGETHER_MS)).toBeNull();
  });

  it('to whoever may not answer as what waits for others', () => {
    const herald = new Herald();
    herald.take([]);
    herald.take(asked('mug_1'));
    expect(herald.speak(0, undefined, awaited({ role: 'auditor' }))).toBe('Waiting for operators: Grasp mug_1, medium risk.');
  });

  it('together, in one sentence, when more come on the heels of the first', () => {
    const herald = new Herald();
    herald.take([]);
    herald.take(asked('a'));
    herald.speak(0);
    for (const [k, name] of ['b', 'c', 'd', 'e'].entries()) {
      herald.take(asked(name, ...['a', 'b', 'c', 'd'].slice(0, k + 1)));
      expect(herald.speak(k + 1)).toBeNull();
    }
    expect(herald.dueInMs(10)).toBe(TOGETHER_MS - 10);
    expect(herald.speak(TOGETHER_MS)).toBe('4 new questions, 5 wait for you. Most urgent of the new: Grasp e, medium risk.');
  });

  it('in other letters than the one before, which may have gone in the same drawing: what stays the same is not heard', () => {
    const herald = new Herald();
    herald.take([]);
    const said = ['one', 'two', 'three'].map((id, k) => {
      herald.take([escalation({ id, effective: { object_id: 'mug_1' } })]);
      return herald.speak(k * TOGETHER_MS) ?? '';
    });
    expect(said.map((words) => words.trim())).toEqual(Array(3).fill('Waiting for you: Grasp mug_1, medium risk.'));
    expect(said[1]).not.toBe(said[0]);
    expect(said[2]).not.toBe(said[1]);
  });

  it('not any more when they were answered meanwhile', () => {
    const herald = new Herald();
    herald.take([]);
    herald.take(asked('a'));
    herald.speak(0);
    herald.take(asked('a', 'b'));
    herald.take(asked('a'));
    expect(herald.dueInMs(0)).toBeNull();
  });

  it('again where the link comes back with what came while it was down', () => {
    const herald = new Herald();
    herald.take(asked('a'));
    herald.take(asked('a', 'b'));
    expect(herald.speak(0, () => ' in workcell-2')).toBe('Waiting for you: Grasp b in workcell-2, medium risk.');
  });
});

describe('what waits, wherever one is', () => {
  const due = (id: string, at: string): Escalation => escalation({ id, expires_at: `2026-11-22T${at}Z` });
  const now = Date.parse('2026-11-22T10:00:00Z');
  const approved = { ...due('mine', '10:00:20'), approvals: [{ by: 'operator', at: '', digest: '' }] };
  it('is what this person can still answer, with the time until the first of it lapses', () => {
    const waits = outstandingOf([due('a', '10:02:00'), approved, due('b', '10:01:24')], now, 'operator');
    expect([waits, questionsWords(waits), tabTitle(waits)]).toEqual([{ count: 2, leftMs: 84_000 }, '2 questions', '(2, 1:24) Reins console']);
  });
  it('has no time left to tell of where nothing lapses, and is nothing where nothing waits or is known', () => {
    const waits = outstandingOf([escalation({ expires_at: null })], now, null);
    expect([questionsWords(waits), tabTitle(waits)]).toEqual(['1 question', '(1) Reins console']);
    expect([tabTitle(outstandingOf([approved], now, 'operator')), tabTitle(null)]).toEqual(['Reins console', 'Reins console']);
  });
});

describe('leafing through the questions', () => {
  const sorted = asked('a', 'b', 'c');
  it('goes on in their order and round at the end', () => {
    expect(nextOf(sorted, 'a')?.id).toBe('b');
    expect(nextOf(sorted, 'c')?.id).toBe('a');
    expect(nextOf(asked('a'), 'a')).toBeNull();
  });
  it('names what lapses first of what is not open', () => {
    const [a, b, c] = ['10:03', '10:01', '10:02'].map((at, k) => escalation({ id: 'abc'.charAt(k), expires_at: `2026-11-22T${at}:00Z` }));
    if (a === undefined || b === undefined || c === undefined) throw new Error('three');
    expect(soonestOf([a, b, c], 'b', 0, 'operator')?.id).toBe('c');
    expect(soonestOf([b], 'b', 0, 'operator')).toBeNull();
  });
});
