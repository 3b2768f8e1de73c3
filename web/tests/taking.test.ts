import { describe, expect, it } from 'vitest';
import type { Control } from '../src/lib/api/documents';
import { takeControls, type Asking } from '../src/lib/live/taking';

/** What becomes of controls that come when who asked for them looks elsewhere, or has gone. */
async function taken(running: string | null, looks: boolean, gone: boolean): Promise<string[]> {
  const done: string[] = [];
  const control: Control = { lease: 'lease_1', holder: 'ann', where: 'remote', since: '', invocation: running ?? 'inv_idle' };
  let answer: (of: Control) => void = () => undefined;
  const come = (_: string, after: number): Promise<Control> => new Promise((resolve) => (answer = after === 7 ? resolve : () => undefined));
  const of: Asking = {
    api: { takeOver: come, takeCell: come, release: (id, then) => Promise.reject(new Error(String(done.push(`${then} ${id}`)))) },
    looksAt: () => looks,
    gone: () => gone,
    took: (lease) => done.push(lease),
    cameLate: (cell) => done.push(`late ${cell}`),
  };
  const asked = takeControls(of, 'workcell-1', running, 7);
  answer(control);
  await asked;
  return done;
}

describe('controls that were asked for', () => {
  it('are taken by who still looks at the cell', async () => {
    expect([await taken(null, true, false), await taken('inv_1', true, false)]).toEqual([['lease_1'], ['lease_1']]);
  });

  it('of an idle cell go back at once where nobody looks at it', async () => {
    expect([await taken(null, false, false), await taken(null, false, true)]).toEqual([['late workcell-1', 'end inv_idle'], ['late workcell-1', 'end inv_idle']]);
  });

  it('of a session are no word on which it goes on: they are there to go back to, or nobody’s who signed in since', async () => {
    expect([await taken('inv_1', false, false), await taken('inv_1', false, true)]).toEqual([['lease_1'], []]);
  });
});
