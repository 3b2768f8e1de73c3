import { describe, expect, it } from 'vitest';
import { Outbox } from '../src/lib/socket/outbox';

interface Said {
  is: 'word' | 'health';
  n: number;
}

describe('what waits for a page', () => {
  const made = (): { sent: (readonly Said[])[]; page: Outbox<Said> } => {
    const sent: (readonly Said[])[] = [];
    return { sent, page: new Outbox<Said>((all) => sent.push(all), 'health') };
  };
  const numbers = (sent: readonly (readonly Said[])[]): number[][] => sent.map((all) => all.map(({ n }) => n));

  it('goes at once to a page that takes it', () => {
    const { sent, page } = made();
    page.put({ is: 'word', n: 1 });
    page.took();
    page.put({ is: 'word', n: 2 });
    expect(numbers(sent)).toEqual([[1], [2]]);
  });

  it('comes in one go, and in order, to one that is slow', () => {
    const { sent, page } = made();
    for (let n = 1; n <= 50; n += 1) page.put({ is: 'word', n });
    expect(numbers(sent)).toEqual([[1]]);
    page.took();
    expect(numbers(sent).at(-1)).toEqual(Array.from({ length: 49 }, (_, k) => k + 2));
    page.took();
    page.took();
    expect(sent.length).toBe(2);
  });

  it('tells the newest of what is worth telling only as it is now', () => {
    const { sent, page } = made();
    page.put({ is: 'word', n: 1 });
    page.put({ is: 'health', n: 2 });
    page.put({ is: 'word', n: 3 });
    page.put({ is: 'health', n: 4 });
    page.took();
    expect(numbers(sent)).toEqual([[1], [3, 4]]);
  });
});
