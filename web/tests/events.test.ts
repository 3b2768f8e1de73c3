import { describe, expect, it } from 'vitest';
import { cellOf, entriesOf, eventLine } from '../src/lib/format/events';
import { Keys } from '../src/lib/keys/keys';
import { cell, event, invocation } from './samples';

const DOCS = {
  cells: { 'workcell-1': cell(), 'workcell-2': cell({ id: 'workcell-2' }) },
  invocations: { inv_1: invocation({ cell: 'workcell-2' }) },
};

describe('where something happened', () => {
  it('is said by the event, or else by its session, or else by the cell that speaks', () => {
    expect(cellOf(event('human', { op: 'estop', cell: 'workcell-1' }, null, 'operator'), DOCS)).toBe('workcell-1');
    expect(cellOf(event('policy', { outcome: 'allow' }, 'inv_1', 'kernel'), DOCS)).toBe('workcell-2');
    expect(cellOf(event('cell', { what: 'estop' }, null, 'workcell-1'), DOCS)).toBe('workcell-1');
    expect(cellOf(event('boot', {}, null, 'server'), DOCS)).toBeNull();
  });

  it('keeps what two cells say alike apart', () => {
    const events = [event('cell', { link: 'attached' }, null, 'workcell-1'), event('cell', { link: 'attached' }, null, 'workcell-2')];
    const entries = entriesOf(events, 10, (one) => cellOf(one, DOCS));
    expect(entries.map((entry) => [entry.cell, entry.times])).toEqual([['workcell-2', 1], ['workcell-1', 1]]);
  });
});

describe('a standing grant', () => {
  const said = (op: string, grant: Record<string, string | Record<string, string> | null>): string => {
    const line = eventLine(event('grant', { op, grant: { capability: 'grasp_object', object: 'glass_1', task: null, ...grant } }, null, 'ann'));
    return `${line.strong}${line.text}`;
  };
  it('says what it is for, and why it ended', () => {
    expect(said('given', { ended: null })).toBe('ann opened a standing grant: grasp object glass_1');
    expect(said('ended', { ended: { code: 'revoked', by: 'bob' } })).toBe('bob revoked a standing grant: grasp object glass_1');
    expect(said('ended', { ended: { code: 'expired', by: 'server' } })).toBe('Standing grant ran out: grasp object glass_1');
    expect(said('ended', { object: null, ended: { code: 'another', by: 'server' } })).toBe('Standing grant ended: grasp object');
  });
});

describe('what a cell says it was told', () => {
  it('is said in words an operator uses', () => {
    const said = (op: string): string => eventLine(event('human', { op }, 'inv_1', 'workcell-1')).text.trim();
    expect(said('confirm')).toBe('goes on, as a person confirmed');
    expect(said('end_takeover')).toBe('ended the session that was driven by hand');
  });
});

describe('a key that several listen to', () => {
  const escape = { key: 'Escape', repeat: false, ctrlKey: false, metaKey: false, altKey: false, defaultPrevented: false };

  it('goes to the newest that takes it', () => {
    const keys = new Keys();
    const heard: string[] = [];
    keys.on('Escape', 'Close the menu', () => heard.push('menu'));
    keys.on('Escape', 'Close this list', () => { heard.push('list'); return false; });
    expect(keys.press(escape, false)).toBe(true);
    expect(heard).toEqual(['list', 'menu']);
  });

  it('is left to the page where nobody takes it', () => {
    const keys = new Keys();
    keys.on('Escape', 'Close this list', () => false);
    expect(keys.press(escape, false)).toBe(false);
  });
});
