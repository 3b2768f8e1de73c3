import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import { ApiError } from '../src/lib/api/client';
import type { Cell } from '../src/lib/api/documents';
import { Stopper } from '../src/lib/state/stopper.svelte';

describe('a stop that is pressed', () => {
  let sent: string[];
  let answer: () => Promise<Cell>;
  let stopper: Stopper;

  beforeEach(() => {
    vi.useFakeTimers({ now: 0 });
    sent = [];
    answer = () => Promise.reject(new Error('The server did not answer.'));
    stopper = new Stopper((cell) => {
      sent.push(cell);
      return answer();
    }, () => Date.now());
  });
  afterEach(() => {
    vi.useRealTimers();
  });

  it('is said not to be confirmed, and sent on until it is', async () => {
    void stopper.press('workcell-1');
    await vi.advanceTimersByTimeAsync(9_000);
    expect(stopper.phase).toBe('sending');
    await vi.advanceTimersByTimeAsync(2_000);
    expect([stopper.phase, stopper.trying]).toEqual(['failed', true]);
    const before = sent.length;
    answer = () => Promise.resolve({ id: 'workcell-1' } as Cell);
    await vi.advanceTimersByTimeAsync(1_000);
    expect([stopper.phase, sent.length]).toEqual(['confirmed', before + 1]);
  });

  it('is sent no more once whoever pressed it knows', async () => {
    void stopper.press('workcell-1');
    await vi.advanceTimersByTimeAsync(11_000);
    stopper.dismiss();
    const before = sent.length;
    await vi.advanceTimersByTimeAsync(5_000);
    expect([stopper.phase, sent.length]).toEqual(['idle', before]);
  });

  it('is not given up for the stop of another cell', async () => {
    void stopper.press('workcell-1');
    await vi.advanceTimersByTimeAsync(1_000);
    void stopper.press('workcell-2');
    await vi.advanceTimersByTimeAsync(1_000);
    sent = [];
    await vi.advanceTimersByTimeAsync(500);
    expect(new Set(sent)).toEqual(new Set(['workcell-1', 'workcell-2']));
    answer = () => Promise.resolve({ id: '' } as Cell);
    await vi.advanceTimersByTimeAsync(500);
    expect(stopper.phase).toBe('confirmed');
  });

  it('is not tried again where the server understood and will not', async () => {
    answer = () => Promise.reject(new ApiError({ code: 'unknown_cell', title: 'No such cell', status: 404, detail: 'there is no such cell' }));
    void stopper.press('workcell-9');
    await vi.advanceTimersByTimeAsync(5_000);
    expect([stopper.phase, stopper.trying, sent.length]).toEqual(['failed', false, 1]);
  });
});
