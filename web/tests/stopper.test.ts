import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import { ApiError } from '../src/lib/api/client';
import type { Cell } from '../src/lib/api/documents';
import { DUE_MS, OTHER_LINE_MS, Stopper } from '../src/lib/state/stopper.svelte';

const ONE = 'workcell-1';
const OTHER = 'workcell-2';

describe('a stop that is pressed', () => {
  let sent: string[];
  let answer: () => Promise<Cell>;
  let down: boolean;
  let elsewhere: string[];
  let seq: number;
  let stopper: Stopper;

  beforeEach(() => {
    vi.useFakeTimers({ now: 0 });
    sent = [];
    elsewhere = [];
    seq = 7;
    down = false;
    answer = () => new Promise((_, reject) => setTimeout(() => reject(new Error('The server did not answer.')), 1_500));
    stopper = new Stopper(
      (cell) => {
        sent.push(cell);
        return answer();
      },
      { linkDown: () => down, otherLine: (cell) => elsewhere.push(cell), seen: () => seq },
    );
  });
  afterEach(() => {
    vi.useRealTimers();
  });

  it('is told of to who leaves before it is confirmed', async () => {
    expect(stopper.leaving).toBe(null);
    void stopper.press(OTHER);
    void stopper.press(ONE);
    expect(stopper.leaving).toBe('The stop of workcell-1, workcell-2 is not confirmed. Use the emergency stop at the cell.');
    answer = () => Promise.resolve({} as Cell);
    await vi.advanceTimersByTimeAsync(2_000);
    expect(stopper.leaving).toBe(null);
  });

  it('is said not to be confirmed after the first attempt, and sent on until it is', async () => {
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(1_400);
    expect([stopper.of(ONE).phase, stopper.unconfirmed]).toEqual(['sending', []]);
    await vi.advanceTimersByTimeAsync(200);
    expect([stopper.of(ONE), stopper.unconfirmed]).toEqual([{ phase: 'failed', why: 'The server did not answer.', trying: true }, [ONE]]);
    await vi.advanceTimersByTimeAsync(60_000);
    expect(stopper.of(ONE).phase).toBe('failed');
    answer = () => Promise.resolve({ id: ONE } as Cell);
    await vi.advanceTimersByTimeAsync(2_000);
    expect([stopper.of(ONE).phase, stopper.unconfirmed]).toEqual(['idle', []]);
    const count = sent.length;
    await vi.advanceTimersByTimeAsync(5_000);
    expect(sent.length).toBe(count);
  });

  it('is said not to be confirmed at once where the link is known to be down', async () => {
    down = true;
    void stopper.press(ONE);
    expect([stopper.of(ONE), sent]).toEqual([{ phase: 'failed', why: 'The link is down.', trying: true }, [ONE]]);
    answer = () => Promise.resolve({ id: ONE } as Cell);
    await vi.advanceTimersByTimeAsync(2_000);
    expect(stopper.of(ONE).phase).toBe('idle');
  });

  it('is said on the other line where it is not answered soon, or not at all, and nowhere else', async () => {
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(OTHER_LINE_MS);
    expect(elsewhere).toEqual([ONE]);
    answer = () => Promise.reject(new ApiError({ code: 'unreachable', title: 'No answer', status: 0, detail: 'no answer' }));
    await vi.advanceTimersByTimeAsync(2_000);
    expect(elsewhere.length).toBeGreaterThan(2);
    answer = () => Promise.resolve({ id: ONE } as Cell);
    void stopper.press(OTHER);
    await vi.advanceTimersByTimeAsync(5_000);
    expect(elsewhere).not.toContain(OTHER);
  });

  it('is confirmed by an answer that comes late, and is sent no more from then on', async () => {
    answer = () => new Promise((resolve) => setTimeout(() => resolve({ id: ONE } as Cell), 3_000));
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(2_900);
    expect([stopper.of(ONE), sent.length]).toEqual([{ phase: 'failed', why: 'The server has not answered yet.', trying: true }, 2]);
    await vi.advanceTimersByTimeAsync(200);
    expect([stopper.of(ONE).phase, stopper.unconfirmed]).toEqual(['idle', []]);
    await vi.advanceTimersByTimeAsync(20_000);
    expect([sent.length, elsewhere.length, stopper.of(ONE).phase]).toEqual([2, 2, 'idle']);
  });

  it('has two attempts on their way at most, and what is pressed then goes out on the other line', async () => {
    answer = () => new Promise(() => undefined);
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(60_000);
    const said = elsewhere.length;
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(60_000);
    expect([sent.length, elsewhere.length - said, stopper.of(ONE).phase]).toEqual([2, 1, 'failed']);
  });

  it('is said on the other line as soon as that is there again, while what was sent before hangs, and once it is confirmed no more', async () => {
    answer = () => new Promise(() => undefined);
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(5_000);
    const said = elsewhere.length;
    stopper.linked();
    expect(elsewhere.slice(said)).toEqual([ONE]);
    stopper.recorded(ONE, seq + 1);
    stopper.linked();
    expect(elsewhere.length).toBe(said + 1);
  });

  it('is not tried again where the server says late that it will not', async () => {
    const refusal = new ApiError({ code: 'forbidden', title: 'Not yours', status: 403, detail: 'not yours' });
    answer = () => new Promise((_, reject) => setTimeout(() => reject(refusal), 2_000));
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(20_000);
    expect([stopper.of(ONE), sent.length]).toEqual([{ phase: 'failed', why: 'Not yours.', trying: false }, 2]);
    answer = () => Promise.resolve({ id: ONE } as Cell);
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(0);
    expect([stopper.of(ONE).phase, sent.length]).toEqual(['idle', 3]);
  });

  it('is under way until the page shows it, and pressed again meanwhile it is sent again', async () => {
    answer = () => Promise.resolve({ id: ONE } as Cell);
    let show: () => void = () => undefined;
    stopper = new Stopper((cell) => (sent.push(cell), answer()), { shown: () => new Promise((resolve) => (show = resolve)) });
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(DUE_MS + 1_000);
    expect([stopper.of(ONE).phase, sent.length]).toEqual(['sending', 1]);
    const before = show;
    answer = () => new Promise(() => undefined);
    void stopper.press(ONE);
    before();
    await vi.advanceTimersByTimeAsync(100);
    expect([stopper.of(ONE).phase, sent.length]).toEqual(['sending', 2]);
  });

  it('ends once the page shows it', async () => {
    answer = () => Promise.resolve({ id: ONE } as Cell);
    let show: () => void = () => undefined;
    stopper = new Stopper(() => answer(), { shown: () => new Promise((resolve) => (show = resolve)) });
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(0);
    show();
    await vi.advanceTimersByTimeAsync(0);
    expect(stopper.of(ONE).phase).toBe('idle');
  });

  it('is confirmed by the record of it, and by none from before it was pressed', async () => {
    answer = () => new Promise(() => undefined);
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(DUE_MS);
    stopper.recorded(ONE, 7);
    stopper.recorded(OTHER, 8);
    expect(stopper.of(ONE).phase).toBe('failed');
    stopper.recorded(ONE, 8);
    expect([stopper.of(ONE).phase, sent.length]).toEqual(['idle', 1]);
    await vi.advanceTimersByTimeAsync(20_000);
    expect(sent.length).toBe(1);
  });

  it('is one of a cell of whatever name', () => {
    void stopper.press('constructor');
    expect([sent, stopper.of('constructor').phase, stopper.of('toString').phase]).toEqual([['constructor'], 'sending', 'idle']);
  });

  it('goes out at once when it is pressed again between two attempts, and is still called not confirmed', async () => {
    void stopper.press(ONE);
    void stopper.press(ONE); // the finger that comes up
    expect(sent.length).toBe(1);
    await vi.advanceTimersByTimeAsync(1_600);
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(0);
    expect([sent.length, stopper.of(ONE).phase]).toEqual([2, 'failed']);
    await vi.advanceTimersByTimeAsync(300);
    expect(sent.length).toBe(2);
  });

  it('is sent no more once whoever pressed it knows, and again when it is pressed anew', async () => {
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(2_000);
    stopper.dismiss(ONE);
    const before = sent.length;
    await vi.advanceTimersByTimeAsync(5_000);
    expect([stopper.of(ONE).phase, sent.length]).toEqual(['idle', before]);
    void stopper.press(ONE);
    expect([stopper.of(ONE).phase, sent.length]).toEqual(['sending', before + 1]);
  });

  it('of one cell is neither given up nor forgotten for that of another', async () => {
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(1_600);
    void stopper.press(OTHER);
    expect([stopper.of(ONE).phase, stopper.of(OTHER).phase, stopper.unconfirmed]).toEqual(['failed', 'sending', [ONE]]);
    await vi.advanceTimersByTimeAsync(1_600);
    expect(stopper.unconfirmed).toEqual([ONE, OTHER]);
    stopper.dismiss(OTHER);
    expect(stopper.unconfirmed).toEqual([ONE]);
    sent = [];
    await vi.advanceTimersByTimeAsync(4_000);
    expect(new Set(sent)).toEqual(new Set([ONE]));
  });

  it.each([
    ['a proxy that is tired of waiting', 408, 'unknown'],
    ['a proxy that wants it later', 425, 'unknown'],
    ['a proxy that counts requests', 429, 'unknown'],
    ['a proxy that knows no such address', 404, 'unknown'],
    ['the server, of too many', 429, 'too_many_requests'],
  ])('is tried again where %s answered', async (_, status, code) => {
    answer = () => Promise.reject(new ApiError({ code, title: '', status, detail: 'not now' }));
    void stopper.press(ONE);
    await vi.advanceTimersByTimeAsync(1_000);
    expect(stopper.of(ONE)).toEqual({ phase: 'failed', why: 'Not now.', trying: true });
    answer = () => Promise.resolve({ id: ONE } as Cell);
    await vi.advanceTimersByTimeAsync(1_000);
    expect(stopper.of(ONE).phase).toBe('idle');
  });

  it('is not tried again where the server understood and will not', async () => {
    answer = () => Promise.reject(new ApiError({ code: 'unknown_cell', title: 'No such cell', status: 404, detail: 'there is no such cell' }));
    void stopper.press('workcell-9');
    await vi.advanceTimersByTimeAsync(5_000);
    expect([stopper.of('workcell-9'), sent.length]).toEqual([{ phase: 'failed', why: 'There is no such cell.', trying: false }, 1]);
  });
});
