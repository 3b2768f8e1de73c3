import { deflateRawSync } from 'node:zlib';
import { describe, expect, it, vi } from 'vitest';
import { ApiError } from '../src/lib/api/client';
import type { Comparison, Version, VersionList } from '../src/lib/api/documents';
import { candidateOf, filesOf, inOrder, lineSpan, read, standings } from '../src/lib/policy/candidate';
import { Draft } from '../src/lib/policy/draft.svelte';
import { decidedAs, deedOf, shortVersion } from '../src/lib/policy/versions';
import { Versions } from '../src/lib/policy/versions.svelte';
import { Whys } from '../src/lib/policy/whys.svelte';
import { PickUnreadable, unzip } from '../src/lib/policy/zip';

/** An archive as packers write it: local headers with their data, the central directory, its end. */
function archive(entries: Record<string, string>, { deflated = true, flags = 0, size = 0 } = {}): ArrayBuffer {
  const chunks: Buffer[] = [];
  const directory: Buffer[] = [];
  let at = 0;
  for (const [path, text] of Object.entries(entries)) {
    const raw = Buffer.from(text);
    const data = deflated ? deflateRawSync(raw) : raw;
    const name = Buffer.from(path);
    const local = Buffer.alloc(30);
    local.writeUInt32LE(0x04034b50, 0);
    local.writeUInt16LE(name.length, 26);
    const central = Buffer.alloc(46);
    central.writeUInt32LE(0x02014b50, 0);
    central.writeUInt16LE(flags, 8);
    central.writeUInt16LE(deflated ? 8 : 0, 10);
    central.writeUInt32LE(data.length, 20);
    central.writeUInt32LE(size === 0 ? raw.length : size, 24);
    central.writeUInt16LE(name.length, 28);
    central.writeUInt32LE(at, 42);
    chunks.push(local, name, data);
    directory.push(central, name);
    at += 30 + name.length + data.length;
  }
  const index = Buffer.concat(directory);
  const end = Buffer.alloc(22);
  end.writeUInt32LE(0x06054b50, 0);
  end.writeUInt16LE(Object.keys(entries).length, 10);
  end.writeUInt32LE(at, 16);
  const whole = Buffer.concat([...chunks, index, end]);
  return whole.buffer.slice(whole.byteOffset, whole.byteOffset + whole.length);
}

const WHOLE = { 'site.yaml': 'site: a', 'organization.yaml': 'o', 'authority.yaml': 'h', 'profiles/a.yaml': 'profile: a' };
const picked = (files: Record<string, string>) => Object.entries(files).map(([path, text]) => ({ path, text }));

describe('an archive', () => {
  it.each([true, false])('gives its files back (deflated: %s)', async (deflated) => {
    const found = await unzip(archive({ 'p/': '', 'p/site.yaml': 'site: a\n'.repeat(99) }, { deflated }));
    expect(found.map(({ path, bytes }) => [path, new TextDecoder().decode(bytes)])).toEqual([['p/site.yaml', 'site: a\n'.repeat(99)]]);
  });

  it.each([
    ['that is none', new ArrayBuffer(40), 'no ZIP archive'],
    ['that is encrypted', archive({ a: 'b' }, { flags: 1 }), 'not read here'],
    ['cut short', archive({ 'a.yaml': 'b' }).slice(20), 'damaged'],
    ['that says another size', archive({ a: 'bbbb' }, { size: 2 }), 'larger than it says'],
    ['that is larger than any policy', archive({ a: 'b' }, { size: 99_000_000 }), 'larger than any policy'],
  ])('%s is refused', async (_, bytes, why) => {
    await expect(unzip(bytes)).rejects.toThrow(why);
    await expect(unzip(bytes)).rejects.toBeInstanceOf(PickUnreadable);
  });
});

describe('a candidate', () => {
  it('is what stands around site.yaml, whatever folder that is in', () => {
    const found = candidateOf(picked(Object.fromEntries(Object.entries(WHOLE).map(([path, text]) => [`./shop/policies/${path}`, text]))), { 'x.yaml': 'y' });
    expect(found).toEqual({ files: WHOLE, leftOut: [], partial: false });
  });

  it('leaves out what is no part of it, and says so', () => {
    const more = { 'README.md': 'r', '.git/config.yaml': 'g', '__MACOSX/site.yaml': 'm' };
    const found = candidateOf(picked({ ...WHOLE, ...more }), {});
    expect(found.files).toEqual(WHOLE);
    expect(found.leftOut).toEqual(Object.keys(more));
  });

  it('keeps its promises, those of what is in force too', () => {
    const promises = 'order: []';
    expect(candidateOf(picked({ ...WHOLE, 'properties.yaml': promises }), {}).files['properties.yaml']).toBe(promises);
    const live = filesOf({ files: WHOLE, promises });
    expect(candidateOf(picked({ 'a.yaml': 'profile: a\nnew: 1' }), live).files['properties.yaml']).toBe(promises);
    expect(filesOf({ files: WHOLE, promises: null })).toEqual(WHOLE);
  });

  it('takes the rest from what is in force where only some files are picked', () => {
    const found = candidateOf(picked({ 'a.yaml': 'profile: a\nnew: 1' }), WHOLE);
    expect(found).toEqual({ files: { ...WHOLE, 'profiles/a.yaml': 'profile: a\nnew: 1' }, leftOut: [], partial: true });
  });

  it.each([
    ['# c\nprofile: b', 'profiles/b.yaml'],
    ['name: b', 'capabilities/b.yaml'],
    ['cases: []', 'tests/b.yaml'],
    ['what: b', 'b.yaml'],
  ])('puts a new file where its first key says: %j', (text, path) => {
    expect(candidateOf(picked({ 'b.yaml': text }), WHOLE).files[path]).toBe(text);
  });

  it('is read from an archive and from files alike', async () => {
    const zip = new File([archive({ 'p/site.yaml': 'site: a', 'p/x.png': 'png' })], 'p.ZIP');
    const found = await read([zip, new File(['profile: a'], 'a.yaml'), new File([new Uint8Array([255])], 'b.png')]);
    expect(found).toEqual([{ path: 'p/site.yaml', text: 'site: a' }, { path: 'p/x.png', text: '' }, { path: 'a.yaml', text: 'profile: a' }, { path: 'b.png', text: '' }]);
    await expect(read([new File([new Uint8Array([255, 254])], 'a.yaml')])).rejects.toThrow('no UTF-8 text');
  });

  it('says how every file stands to what is in force, changes first', () => {
    const files = { ...WHOLE, 'site.yaml': 'other', 'profiles/b.yaml': 'new', 'tests/a.yaml': 'cases' } as Record<string, string>;
    delete files['authority.yaml'];
    expect(standings(files, WHOLE).map(({ path, standing }) => `${standing} ${path}`)).toEqual([
      'new profiles/b.yaml', 'changed site.yaml', 'gone authority.yaml', 'same organization.yaml', 'same profiles/a.yaml', 'same tests/a.yaml',
    ]);
  });

  it('has its faults in order, each on its line', () => {
    const fault = (file: string, line: number) => ({ file, line, field: '', message: '' });
    expect(inOrder([fault('b', 1), fault('a', 12), fault('a', 3)]).map(({ file, line }) => `${file}${line}`)).toEqual(['a3', 'a12', 'b1']);
    expect(['one\ntwo\n', 'one\ntwo'].map((text) => lineSpan(text, 2))).toEqual([[4, 7], [4, 7]]);
    expect([lineSpan('one', 0), lineSpan('one', 9)]).toEqual([[0, 3], [0, 3]]);
  });
});

const version = (over: Partial<Version> = {}): Version => ({
  digest: 'sha256:b', status: 'candidate', source: 'request', by: 'ada', why: 'w', against: 'sha256:a', rules: 1, cases: 2, proved: 'all', verdict: 'proved', awaiting: null, activations: [],
  created_at: '', updated_at: '', ...over,
});

describe('a version', () => {
  const active = version({ digest: 'sha256:a', status: 'active', activations: [{ at: '', by: ['ada'], why: '', former: 'sha256:z', direction: null }] });
  const found = (direction: Comparison['direction']): Comparison => ({ direction, differences: [] });
  const deed = (version: Version, active: Version | null, who: { name: string; role: string } | null, live: boolean, found: Comparison | null) => deedOf({ version, active, who, live, found });
  const ada = { name: 'ada', role: 'engineer' };
  const bob = { name: 'bob', role: 'engineer' };

  it('that is in force leaves nothing to do', () => {
    expect(deed(active, active, ada, true, null)).toBeNull();
  });

  it('that tightens takes one engineer', () => {
    expect(deed(version(), active, ada, true, found('tightens'))).toEqual({ label: 'Put in force', says: 'It loosens nothing: one engineer is enough.', barrier: null });
  });

  it('that loosens takes another engineer than the one who brought it', () => {
    expect(deed(version(), active, ada, true, found('both'))).toMatchObject({ label: 'Give the first word', says: expect.stringContaining('another engineer has to give the second') as string });
    expect(deed(version(), active, bob, true, found('loosens'))?.label).toBe('Put in force');
    expect(deed(version(), active, bob, true, found('loosens'))?.says).toContain('your word is the second');
    expect(deed(version({ against: 'sha256:old' }), active, bob, true, found('loosens'))?.says).toContain('yours is the first word');
  });

  it('that waits for a second word takes it from another person only', () => {
    const waiting = version({ status: 'awaiting_second', awaiting: { by: 'ada', at: '', why: '', against: 'sha256:a' } });
    expect(deed(waiting, active, ada, true, found('loosens'))).toMatchObject({ label: 'Give the second word', barrier: 'You gave the first word: another engineer has to give the second.' });
    expect(deed(waiting, active, bob, true, found('loosens'))).toMatchObject({ label: 'Give the second word', barrier: null });
    expect(deed(waiting, version({ digest: 'sha256:c', status: 'active' }), ada, true, found('loosens'))).toMatchObject({ label: 'Give the first word', barrier: null });
  });

  it('waits for nobody’s second word where another change came and went since the first', () => {
    const back = version({ ...active, activations: [{ at: '2026-01-02T00:00:00Z', by: ['bob', 'eve'], why: '', former: 'sha256:z', direction: null }] });
    const waiting = version({ status: 'awaiting_second', awaiting: { by: 'ada', at: '2026-01-01T00:00:00Z', why: '', against: 'sha256:a' } });
    expect(deed(waiting, back, bob, true, found('loosens'))).toMatchObject({ label: 'Give the first word', says: expect.stringContaining('yours is the first word') as string });
    expect(deed({ ...waiting, awaiting: { by: 'ada', at: '2026-01-03T00:00:00Z', why: '', against: 'sha256:a' } }, back, bob, true, found('loosens'))?.label).toBe('Give the second word');
  });

  it('that was in force is gone back to, or put in force again', () => {
    const former = version({ digest: 'sha256:z', status: 'former', activations: active.activations });
    expect(deed(former, active, ada, true, found('tightens'))?.label).toBe('Roll back to this');
    expect(deed({ ...former, digest: 'sha256:y' }, active, ada, true, found('tightens'))?.label).toBe('Put in force again');
  });

  it.each([
    [null, true, 'Engineers'],
    [{ name: 'eve', role: 'operator' }, true, 'Engineers'],
    [ada, false, 'link is down'],
  ])('is put in force by an engineer over a link that holds', (who, live, why) => {
    expect(deed(version(), active, who, live, null)?.barrier).toContain(why);
  });

  it('is put in force, or given the second word, by nobody before it is compared', () => {
    const waiting = version({ status: 'awaiting_second', awaiting: { by: 'ada', at: '', why: '', against: 'sha256:a' } });
    for (const one of [version(), waiting]) expect(deed(one, active, bob, true, null)?.barrier).toBe('What it changes has to be compared first.');
  });

  it('is put in force in the place of what is known to be', () => {
    expect(deed(version(), null, ada, true, null)?.barrier).toBe('What is in force is not known yet.');
  });

  it('is said in words', () => {
    expect(shortVersion('sha256:0123456789abcdef')).toBe('0123456789ab');
    expect([decidedAs('awaiting_approval (modify)'), decidedAs('denied (deny)'), decidedAs('invalid')]).toEqual(['awaiting approval, with bounds', 'denied', 'invalid']);
  });
});

describe('a draft', () => {
  const server = (files: Record<string, string>) => ({
    versions: () => Promise.resolve({ items: [], next: null, active: 'sha256:1', why: '' }),
    policyFiles: () => Promise.resolve({ files, promises: null }),
  });
  const change = [new File(['profile: a\nnew: 1'], 'a.yaml')];

  it('asks what is in force, and takes from it what was not picked', async () => {
    const draft = new Draft();
    await draft.take(change, server(WHOLE));
    expect(draft.files).toEqual({ ...WHOLE, 'profiles/a.yaml': 'profile: a\nnew: 1' });
    expect(draft.listed[0]).toEqual({ path: 'profiles/a.yaml', standing: 'changed' });
  });

  it('is none where nobody says what is in force, and says why', async () => {
    const draft = new Draft();
    await draft.take(change, { ...server(WHOLE), versions: () => Promise.reject(new TypeError('Failed to fetch')) });
    expect([draft.empty, draft.trouble, draft.busy]).toEqual([true, 'TypeError: Failed to fetch', null]);
  });

  it('says in a sentence what of a pick cannot be read', async () => {
    const draft = new Draft();
    await draft.take([new File([new Uint8Array([255, 254])], 'a.yaml')], server(WHOLE));
    expect([draft.empty, draft.trouble]).toEqual([true, '“a.yaml” is no UTF-8 text.']);
  });

  it('is of the last pick, whichever is answered last, and of none that was discarded', async () => {
    const draft = new Draft();
    let answer = (): void => undefined;
    const late = { ...server(WHOLE), versions: () => new Promise<Awaited<ReturnType<ReturnType<typeof server>['versions']>>>((done) => (answer = () => done({ items: [], next: null, active: 'sha256:0', why: '' }))) };
    const first = draft.take([], late);
    await draft.take(change, server(WHOLE));
    answer();
    await first;
    expect(draft.files['profiles/a.yaml']).toBe('profile: a\nnew: 1');
    const second = draft.take([], late);
    draft.clear();
    answer();
    await second;
    expect([draft.empty, draft.busy]).toEqual([true, null]);
  });

  it('says that something was written in it, and is replaced by nothing that was being read by then', async () => {
    const draft = new Draft();
    await draft.take(change, server(WHOLE));
    expect(draft.written).toBe(false);
    const late = draft.take([], server(WHOLE));
    draft.write('site.yaml', 'other');
    await late;
    expect([draft.files['site.yaml'], draft.written, draft.busy]).toEqual(['other', true, null]);
    draft.write('site.yaml', WHOLE['site.yaml']);
    expect(draft.written).toBe(false);
    draft.write('site.yaml', 'other');
    draft.clear();
    expect(draft.written).toBe(false);
  });

  /** A draft that is being checked, and what the server says in the end. */
  async function checked() {
    const draft = new Draft();
    await draft.take(change, server(WHOLE));
    draft.why = 'for a visit';
    let answer = (_: Version | ApiError): void => undefined;
    const propose = vi.fn((..._: [Record<string, string>, string]) => new Promise<Version>((done, fail) => (answer = (of) => (of instanceof ApiError ? fail(of) : done(of)))));
    const done = draft.bring({ propose });
    return { draft, propose, say: (of: Version | ApiError) => (answer(of), done) };
  }
  const fault = (file: string) => ({ field: 'rules', message: 'm', file, line: 2 });
  const refusal = new ApiError({ title: 't', status: 422, detail: 'd', code: 'policy_invalid', errors: [fault('site.yaml')] });

  it('is told to be gone with the page where it differs from what is in force, and not to be where it may have been kept', async () => {
    const draft = new Draft();
    expect(draft.leaving).toBeNull();
    await draft.take([], server(WHOLE));
    expect(draft.leaving).toBeNull();
    draft.write('site.yaml', 'other');
    expect(draft.leaving).toBe('The policy that you were about to bring was not sent, and is gone.');
    draft.clear();
    expect(draft.leaving).toBeNull();
    const sent = await checked();
    expect(sent.draft.leaving).toMatch(/whether it was kept stands under Versions/);
    await sent.say(refusal);
    expect(sent.draft.leaving).toMatch(/not sent, and is gone/);
  });

  it('goes once it is kept, as it was sent', async () => {
    const { draft, propose, say } = await checked();
    draft.write('site.yaml', 'other');
    draft.write('site.yaml', 'site: a');
    await say(version());
    expect(propose.mock.calls[0]?.[1]).toBe('for a visit');
    expect([draft.empty, draft.why, draft.kept?.digest, draft.busy]).toEqual([true, '', 'sha256:b', null]);
  });

  it.each([
    ['a file', (draft: Draft) => draft.write('site.yaml', 'other')],
    ['the reason', (draft: Draft) => (draft.why = 'for two visits')],
  ])('stays as it is where %s was changed while it was checked', async (_, changed) => {
    const { draft, say } = await checked();
    changed(draft);
    const before = [draft.files, draft.why];
    await say(version());
    expect([draft.files, draft.why]).toEqual(before);
    expect([draft.kept?.digest, draft.busy]).toEqual(['sha256:b', null]);
  });

  it('is nobody else’s: who signs in after its writer finds none, nor hears what became of it', async () => {
    const { draft, say } = await checked();
    draft.belongsTo('ann');
    draft.belongsTo('ann'); // after a link that went, or signed in anew
    expect([draft.empty, draft.why, draft.busy]).toEqual([false, 'for a visit', 'checking']);
    draft.belongsTo('bob');
    expect([draft.empty, draft.why, draft.busy]).toEqual([true, '', null]);
    draft.why = 'of bob';
    await say(version());
    expect([draft.why, draft.kept, draft.busy]).toEqual(['of bob', null, null]);
    const refused = await checked();
    refused.draft.belongsTo('ann');
    refused.draft.belongsTo('bob');
    await refused.say(refusal);
    expect([refused.draft.faults, refused.draft.trouble]).toEqual([[], null]);
  });

  it('leads to its first fault, but nobody away from what they write', async () => {
    const quiet = await checked();
    await quiet.say(refusal);
    expect([quiet.draft.chosen, quiet.draft.kept, quiet.draft.faults.length]).toEqual(['site.yaml', null, 1]);
    const writing = await checked();
    writing.draft.write('profiles/a.yaml', 'profile: a\nnew: 2');
    await writing.say(refusal);
    expect([writing.draft.chosen, writing.draft.faults.length]).toEqual(['profiles/a.yaml', 1]);
  });
});

describe('a list of versions', () => {
  const problem = (status: number, code: string) => new ApiError({ title: code, status, detail: code, code });
  const list = { versions: () => Promise.resolve({ items: [version({ digest: 'sha256:new' })], next: '2', active: 'sha256:old', why: 'w' }) };

  it('asks for what it does not reach to, and says that there is none only where the server does', async () => {
    const asked: string[] = [];
    const ask = (digest: string) => {
      asked.push(digest);
      return digest === 'sha256:old' ? Promise.resolve(version({ digest })) : Promise.reject(problem(404, 'policy_unknown'));
    };
    const versions = new Versions({ ...list, version: ask });
    expect([versions.asked, versions.find('sha256:old'), versions.inForce]).toEqual([false, undefined, null]);
    await versions.refresh();
    expect([versions.asked, versions.find('sha256:old'), versions.find('sha256:none')]).toEqual([true, undefined, undefined]);
    for (const digest of ['sha256:new', 'sha256:old', 'sha256:none']) await versions.seek(digest);
    expect(asked).toEqual(['sha256:old', 'sha256:none']);
    expect([versions.find('sha256:old')?.digest, versions.inForce?.digest, versions.find('sha256:none')]).toEqual(['sha256:old', 'sha256:old', null]);
  });

  it('shows no older list in the place of a newer one, in whichever order they come', async () => {
    const answers: ((of: VersionList | Error) => void)[] = [];
    const versions = new Versions({ version: (digest) => Promise.resolve(version({ digest })), versions: () => new Promise((done, fail) => answers.push((of) => (of instanceof Error ? fail(of) : done(of)))) });
    const listed = (active: string): VersionList => ({ items: [version({ digest: active })], next: null, active, why: '' });
    const asked = [versions.refresh(), versions.refresh(), versions.refresh(), versions.refresh()];
    answers[1]?.(listed('sha256:second'));
    answers[0]?.(listed('sha256:first'));
    await Promise.all(asked.slice(0, 2));
    expect([versions.active, versions.items[0]?.digest]).toEqual(['sha256:second', 'sha256:second']);
    answers[3]?.(listed('sha256:fourth'));
    answers[2]?.(problem(0, 'unreachable'));
    await Promise.all(asked);
    expect([versions.active, versions.trouble]).toEqual(['sha256:fourth', null]);
  });

  it('takes no failure for a no, nor an older answer for a newer one', async () => {
    const answers: ((of: Version | Error) => void)[] = [];
    const versions = new Versions({ ...list, version: () => new Promise((done, fail) => answers.push((of) => (of instanceof Error ? fail(of) : done(of)))) });
    const [first, second] = [versions.seek('sha256:old'), versions.seek('sha256:old')];
    answers[1]?.(version({ digest: 'sha256:old', why: 'newer' }));
    answers[0]?.(problem(404, 'policy_unknown'));
    await Promise.all([first, second]);
    expect(versions.find('sha256:old')?.why).toBe('newer');
    const third = versions.seek('sha256:constructor');
    answers[2]?.(problem(0, 'unreachable'));
    await third;
    expect([versions.find('sha256:constructor'), versions.trouble]).toEqual([undefined, 'Unreachable.']);
  });
});

describe('why something is done to a version', () => {
  it('is kept for each version, until it was sent as it stands', () => {
    const whys = new Whys();
    whys.write('sha256:a', 'too many near misses');
    whys.write('sha256:b', 'mugs slip');
    expect(['a', 'b', 'c'].map((name) => whys.of(`sha256:${name}`))).toEqual(['too many near misses', 'mugs slip', '']);
    whys.sent('sha256:b', 'mugs slip');
    whys.sent('sha256:a', 'too many');
    expect(['a', 'b'].map((name) => whys.of(`sha256:${name}`))).toEqual(['too many near misses', '']);
  });

  it('is nothing that somebody else finds in the tab', () => {
    const whys = new Whys();
    whys.belongsTo('ann');
    whys.write('sha256:a', 'of ann');
    whys.belongsTo('ann');
    expect(whys.of('sha256:a')).toBe('of ann');
    whys.belongsTo('bob');
    expect(whys.of('sha256:a')).toBe('');
  });
});
