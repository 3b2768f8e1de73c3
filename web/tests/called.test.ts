import { describe, expect, it } from 'vitest';
import { calledOf, isAlike, lostWords } from '../src/lib/live/called';
import { cell, escalation } from './samples';

describe('what a question is called where it does not stand before one', () => {
  const cells = { 'workcell-1': cell({ id: 'workcell-1' }), 'workcell-2': cell({ id: 'workcell-2' }) };
  const grasp = (id: string, where: string, agent: string, force: number): ReturnType<typeof escalation> =>
    escalation({ id, cell: where, agent, effective: { object_id: 'mug_1', force_n: force } });

  it('names its cell where there are several', () => {
    const [here, there] = [grasp('a', 'workcell-1', 'planner', 40), grasp('b', 'workcell-2', 'planner', 40)];
    const known = { cells, escalations: { a: here, b: there } };
    expect([calledOf(here, known), calledOf(there, known)]).toEqual(['Grasp mug_1 in workcell-1', 'Grasp mug_1 in workcell-2']);
    expect(calledOf(here, { ...known, cells: { 'workcell-1': cells['workcell-1'] } })).toMatch(/^Grasp mug_1(?! in )/);
  });

  it('tells it from another one that reads the same by who asks and by its figures', () => {
    const [one, other] = [grasp('a', 'workcell-1', 'planner', 40), grasp('b', 'workcell-1', 'picker', 20)];
    const known = { cells, escalations: { a: one, b: other } };
    expect([one, other].map((asked) => [isAlike(asked, known), calledOf(asked, known)])).toEqual([
      [true, 'Grasp mug_1 in workcell-1 (planner, 40 N)'],
      [true, 'Grasp mug_1 in workcell-1 (picker, 20 N)'],
    ]);
  });
});

describe('what goes with its page', () => {
  it('is named, and nothing is said where there is none', () => {
    expect(lostWords('edit of', [])).toEqual([]);
    expect(lostWords('note on', ['Grasp mug_1', 'Drive to dock'])).toEqual(['Your note on Grasp mug_1, Drive to dock was not sent, and is gone.']);
  });
});
