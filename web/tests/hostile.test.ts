import { describe, expect, it, vi } from 'vitest';
import { ApiError } from '../src/lib/api/client';
import type { Json, Review } from '../src/lib/api/documents';
import { heldIn, titleOf, words } from '../src/lib/format/capability';
import { cellOf, eventLine } from '../src/lib/format/events';
import { ruleWords } from '../src/lib/format/rules';
import { plain } from '../src/lib/format/plain';
import { recorded } from '../src/lib/format/recorded';
import { quoted } from '../src/lib/format/quoted';
import { labelFor, labelOf, valueOf } from '../src/lib/format/quantity';
import { outcomeTone, outcomeWords, statusWords } from '../src/lib/format/status';
import { closingOf } from '../src/lib/live/closed';
import { Decision } from '../src/lib/live/decision.svelte';
import { rowsOf } from '../src/lib/live/edit';
import { refusalWords } from '../src/lib/live/control';
import { reasonLines } from '../src/lib/live/reasons';
import { statedOf } from '../src/lib/live/stated';
import { dueWords } from '../src/lib/live/reviews';
import { stepsText } from '../src/lib/format/edited';
import { escalation, event, invocation } from './samples';

/** What every object brings along, so that a plain table has something under it. */
const NAMES = ['constructor', '__proto__', 'hasOwnProperty', 'valueOf', 'toString'];

describe.each(NAMES)('the name `%s`, which an agent may choose', (name) => {
  const own = (value: Json): Record<string, Json> => Object.fromEntries([[name, value]]);
  const line = (kind: string, body: Record<string, Json>): string => {
    const { strong, text, icon, tone } = eventLine(event(kind, body, 'inv_1', name));
    expect([strong, text, icon, tone].map((part) => typeof part)).toEqual(['string', 'string', 'string', 'string']);
    return `${strong}${text}`;
  };

  it('names a capability that nobody has', () => {
    expect(titleOf(name, {})).toBe(words(name));
    expect(line('proposal', { capability: name, params: own(1) })).toBe(`${name}: ${words(name).replace(/^./, (c) => c.toLowerCase())}`);
  });

  it('is a word like another wherever an event bears it', () => {
    expect(line(name, {})).toBe(words(name));
    expect(line('alert', { signal: 'VIOLATION', rule: name, value: 1, threshold: 2 })).toContain(words(name));
    expect(line('intervention', { intervention: name })).toBe(words(name.toLowerCase()));
    expect(line('human', { op: name })).toBe(`${name} said ${name.replaceAll('_', ' ')}`);
    expect(line('human', { op: 'pause', done: false, refused: name })).toContain(name.replaceAll('_', ' '));
    expect(line('outcome', { outcome: name })).toContain(words(name));
    expect(line('status', { status: name })).toBe(name.replaceAll('_', ' '));
    expect(line('grant', { op: 'ended', grant: { capability: name, ended: { code: name } } })).toContain('ended');
    expect(line('policy', { outcome: 'modify', changes: [{ param: name, requested: 2, effective: 1, rule: name }] })).toContain('2.00 → 1.00');
  });

  it('is no quantity, rule, outcome, status, cell or person that is known', () => {
    expect(labelOf(name)).toBe(words(name));
    expect(labelFor(name, {})).toBe(words(name));
    expect(ruleWords(name)).toBe(words(name));
    expect([outcomeWords(name), outcomeTone(name), statusWords(name).tone]).toEqual([name.replaceAll('_', ' '), 'danger', 'plain']);
    expect(heldIn({}, name)).toBeNull();
    expect(cellOf(event('proposal', {}, name, name), { cells: {}, invocations: {} })).toBeNull();
  });

  it('may be a parameter that is edited, and the reason why one is asked', () => {
    expect(stepsText([{ name, from: undefined, to: 1 }], {})).toContain('1.00');
    expect(rowsOf(escalation({ requested: {}, effective: own(1) })).map((row) => [row.name, row.requested])).toContainEqual([name, undefined]);
    const reasons = [{ rule: name, code: name, message: '`x_m` is too far', remedy: '' }];
    expect(reasonLines(escalation({ kind: 'session', reasons }), null)[0]?.strong).toBe('');
    expect(refusalWords(name)).toContain(name.replaceAll('_', ' '));
  });
});

describe('a name that is drawn over its neighbours, or as nothing', () => {
  const piled = `mug${'\u0301'.repeat(60)}_1`;
  const shown = `mug${'\u0301'.repeat(4)}\uFFFD_1`;

  it('keeps as many marks on a letter as scripts need, in titles and in events', () => {
    expect(titleOf('grasp_object', { object_id: piled })).toBe(`Grasp ${shown}`);
    expect(titleOf(piled, {})).toBe('Mu' + shown.slice(2).replace('_', ' '));
    expect(plain(shown)).toBe(shown);
    for (const name of ['e\u0302\u0301', '\u0E17\u0E35\u0E48', '\u05D1\u05BC\u05B0\u0591', '\u0F66\u0F92\u0FB2\u0F74\u0F56']) expect(plain(name)).toBe(name);
    expect(eventLine(event('proposal', { capability: 'grasp_object', params: { object_id: piled } })).text).toContain(shown);
  });

  it.each(['\u2800', '\u3164', '\u115F', '\u1160', '\uFFA0'])('shows that %j is there', (blank) => {
    expect(titleOf('grasp_object', { object_id: `mug_1${blank}${blank}safe` })).toBe('Grasp mug_1\uFFFD\uFFFDsafe');
  });

  it('shows spaces that are added to a space, and leaves one between words', () => {
    expect([plain('a\u00A0b'), plain('a  b'), plain('a\u3000\u3000\u2003b'), plain('a \u00A0 \u00A0b')]).toEqual(['a\u00A0b', 'a  b', 'a\u3000\uFFFD\uFFFDb', 'a \uFFFD \uFFFDb']);
    expect(statedOf(escalation({ goal: 'a\u3000\u3000b\u2800' }))?.goal).toBe('a b\uFFFD');
  });

  it('keeps joiners where they are drawn, and shows those that are not', () => {
    const drawn = ['\u0645\u06CC\u200C\u062E\u0648\u0627\u0647\u0645', '\u0915\u094D\u200D\u0937', '\u{1F469}\u{1F3FD}\u200D\u{1F52C}', '\u{1F3F3}\uFE0F\u200D\u{1F308}'];
    for (const words of drawn) expect(plain(words)).toBe(words);
    for (const hidden of ['mug\u200D_1', '\u200Dmug_1', 'e\u0301\u200Cx', '\u0645\u200C', '\u0645\u200C\u200C\u0645', '\u{1F469}\u200D']) expect(plain(hidden)).toContain('\uFFFD');
    expect(recorded('\u0645\u200C')).toContain('\\u200c');
  });

  it('is escaped in a record, mark by mark, and nothing of it is lost', () => {
    const record = recorded({ name: piled, blank: '\u2800' });
    expect(record).toContain(`${'\u0301'.repeat(4)}${'\\u0301'.repeat(56)}_1`);
    expect(record).toContain('"\\u2800"');
    expect(JSON.parse(record)).toEqual({ name: piled, blank: '\u2800' });
  });
});

describe('a character that turns a line around', () => {
  // Shown as it comes, it would read `Grasp mug_1 (safe)`.
  const name = 'mug_1 \u202E)efas(\u2066\u{E0041}';
  const shown = 'mug_1 \uFFFD)efas(\uFFFD\uFFFD';
  const reason = { rule: 'x', code: 'x', message: `no \`${name}\` here`, remedy: '' };

  it('is a mark in every word that an agent chose', () => {
    expect(titleOf('grasp_object', { object_id: name })).toBe(`Grasp ${shown}`);
    expect(titleOf('place_object', {}, name)).toContain(shown);
    expect([titleOf(name, {}), words(name), labelOf(name), valueOf('object_id', name), valueOf('x', [name])].filter((text) => /\p{Cf}/u.test(text))).toEqual([]);
    expect(quoted(reason.message)).toBe(`no “${shown}” here`);
    expect(reasonLines(escalation({ reasons: [reason] }), null)[0]?.text).toContain(shown);
  });

  it('is a mark in what an agent says it is after, whole on one line and at no length', () => {
    expect(statedOf(escalation({ goal: ` fetch\n\t\u0007${name} `, task: name }))).toEqual({ goal: `fetch ${shown}`, task: shown });
    expect(statedOf(escalation({ goal: '\u{1F916}'.repeat(5000) }))?.goal).toBe(`${'\u{1F916}'.repeat(159)}…`);
    expect(statedOf(escalation({ goal: `a${'\u0301'.repeat(400)}b` }))?.goal).toBe('a\u0301\u0301b');
    expect([statedOf(escalation()), statedOf(escalation({ goal: ' \n', task: null }))]).toEqual([null, null]);
  });

  it('is a mark in what a refusal says, and why a review is due', async () => {
    const refused = new ApiError({ title: '', status: 409, code: 'edit_refused', detail: '', reasons: [reason] });
    const decision = new Decision({ check: vi.fn(), events: vi.fn(), resolve: () => Promise.reject(refused) }, escalation(), () => ({ schema: {}, cell: null }));
    await decision.approve();
    expect(decision.problem).toBe(`Policy refuses the edited values. no “${shown}” here`);
    expect(dueWords({ reasons: [reason] } as Review)).toBe(`No ${shown} here`);
  });

  it('is escaped in a record that is shown as it is, and nothing of it is lost', () => {
    const record = recorded({ params: { object_id: name } });
    expect(record).toContain('mug_1 \\u202e)efas(\\u2066\\udb40\\udc41');
    expect(JSON.parse(record)).toEqual({ params: { object_id: name } });
  });

  it('is a mark in every line of the log, and where a question closed', () => {
    const bodies: [string, Record<string, Json>][] = [
      ['proposal', { capability: 'grasp_object', params: { object_id: name } }],
      ['admission', { outcome: 'reject', reasons: [{ ...reason }] }],
      ['grant', { op: 'given', grant: { capability: 'grasp_object', task: name } }],
      [name, {}],
    ];
    for (const [kind, body] of bodies) {
      const { strong, text } = eventLine(event(kind, body, 'inv_1', name));
      expect(`${strong}${text}`).toContain('\uFFFD');
      expect(`${strong}${text}`).not.toMatch(/\p{Cf}/u);
    }
    const ends = [event('approval', { decision: 'approve', escalation: { id: 'esc_1', status: 'approved' } }), event('outcome', { outcome: 'rejected', reasons: [{ ...reason }] })];
    expect(closingOf(ends, { id: 'esc_1', invocation: 'inv_1' }, invocation()).words ?? '').not.toMatch(/\p{Cf}/u);
  });
});
