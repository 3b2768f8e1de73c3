import { describe, expect, it } from 'vitest';
import { NOTHING_LOOKED_AT } from '../src/lib/audit/search';
import { foundWords, type Told } from '../src/lib/audit/told';
import { fieldsOf, heldIn, marked, wordsOf } from '../src/lib/audit/words';
import { fullTime } from '../src/lib/format/time';

describe('the words that are looked for', () => {
  it('are each there once, without their case', () => {
    expect(wordsOf('  Mug_1 limit\tMUG_1 ')).toEqual(['mug_1', 'limit']);
    expect(wordsOf(' ')).toEqual([]);
  });

  it.each([
    ['human-shared/tcp_speed_mps', 'SPEED tcp', 'human-shared/[tcp]_[speed]_mps'],
    ['tcp_speed', 'tcp tcp_speed', '[tcp_speed]'],
    ['a (b) [c] $1 a.c', '(b) $1 a.c', 'a [(b)] [c] [$1] [a.c]'],
    ['Straße nach Süd', 'SÜD', 'Straße nach [Süd]'],
    ['nothing', 'x', 'nothing'],
    ['nothing', '', 'nothing'],
    ['', 'x', ''],
  ])('are marked in %s', (text, words, shown) => {
    expect(marked(text, wordsOf(words)).map((piece) => (piece.hit ? `[${piece.text}]` : piece.text)).join('')).toBe(shown);
  });
});

describe('where a document holds words that its line does not show', () => {
  const body = { reasons: [{ rule: 'human-shared/tcp_speed_mps', code: 'limit', message: 'at most 0.25 m/s' }], careful: true, near: null, note: `${'x'.repeat(200)} here ${'😀'.repeat(200)}` };
  const told = (words: string, shown = ''): string[] => heldIn(body, wordsOf(words), shown).map(({ name, text }) => `${name}: ${text}`);

  it('is the first value that does, under its names, or one whose name does', () => {
    expect(fieldsOf(body).map(({ name }) => name)).toEqual(['reasons.rule', 'reasons.code', 'reasons.message', 'careful', 'note']);
    expect(told('TCP_speed')).toEqual(['reasons.rule: human-shared/tcp_speed_mps']);
    expect(told('careful')).toEqual(['careful: true']);
    expect(told('tcp limit mps')).toEqual(['reasons.rule: human-shared/tcp_speed_mps', 'reasons.code: limit']);
    expect(told('tcp limit', 'TCP speed')).toEqual(['reasons.code: limit']);
    expect(told('nothing')).toEqual([]);
    expect(told('')).toEqual([]);
  });

  it('is cut around the word where it is long, and no character in two', () => {
    const [said = ''] = told('here');
    expect(said).toMatch(/^note: …x{29} here 😀+…$/u);
    expect(said.length).toBeLessThan(140);
    expect(said).not.toMatch(/[\uD800-\uDFFF]/u);
  });
});

describe('what was found, in words', () => {
  const at = '2026-03-01T09:30:00Z';
  const say = (of: Partial<Told>): string =>
    foundWords({ what: 'events', count: 0, more: false, looked: { count: 1, at }, searched: false, filtered: false, newestFirst: true, ...of });

  it.each<[Partial<Told>, string]>([
    [{ looked: NOTHING_LOOKED_AT }, 'No events are recorded yet.'],
    [{ looked: NOTHING_LOOKED_AT, what: 'sessions' }, 'No sessions are recorded yet.'],
    [{ looked: NOTHING_LOOKED_AT, filtered: true }, 'Nothing found.'],
    [{}, 'Nothing found'],
    [{ count: 1 }, '1 event'],
    [{ count: 1, what: 'sessions' }, '1 session'],
    [{ count: 200, more: true }, '200 or more events'],
    [{ searched: true, looked: { count: 48_211, at } }, 'Nothing found. All 48,211 events were searched.'],
    [{ searched: true, looked: { count: 200_000, at }, more: true }, `Nothing found so far. The newest 200,000 events were searched, back to ${fullTime(at)}.`],
    [{ searched: true, count: 3, looked: { count: 4000, at }, more: true, what: 'sessions' }, `3 sessions so far. The newest 4,000 sessions were searched, back to ${fullTime(at)}.`],
    [{ searched: true, count: 1, looked: { count: 9, at: null }, more: true, newestFirst: false }, '1 event so far. The oldest 9 events were searched.'],
    [{ searched: true, count: 1 }, '1 event. The only one was searched.'],
    [{ searched: true, looked: NOTHING_LOOKED_AT, filtered: true }, 'Nothing found.'],
  ])('is told for %o', (of, words) => expect(say(of)).toBe(words));
});
