import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import type { Escalation, Invocation } from '../src/lib/api/documents';
import { Console } from '../src/lib/state/console.svelte';
import { cell, escalation, event, invocation, scene } from './samples';

/** The Worker that holds the socket; the test says what comes from it. */
class PlayedWorker {
  static newest: PlayedWorker;
  onmessage: ((event: { data: unknown[] }) => void) | null = null;

  constructor() {
    PlayedWorker.newest = this;
  }
  postMessage(): void {
    // nobody listens
  }
  terminate(): void {
    // nothing runs
  }
  say(message: object): void {
    this.onmessage?.({ data: [{ is: 'message', message, atMs: performance.now() }] });
  }
  up(): void {
    this.onmessage?.({ data: [{ is: 'health', health: { state: 'up', rttMs: 1, framesPerS: 30, why: '' }, atMs: performance.now() }] });
  }
  /** A frame of the cell at this place of those that are watched, in which nothing is. */
  frame(at: number): void {
    const buffer = new ArrayBuffer(28);
    new Uint8Array(buffer).set(new TextEncoder().encode('RPF1'));
    new DataView(buffer).setUint16(4, at, true);
    this.onmessage?.({ data: [{ is: 'frame', buffer }] });
  }
}

describe('the policy that limits are drawn from', () => {
  let asked: { answer: (version: string) => void; fail: () => void }[];
  let page: Console;

  beforeEach(() => {
    vi.useFakeTimers({ now: 0 });
    asked = [];
    vi.stubGlobal('Worker', PlayedWorker);
    vi.stubGlobal('location', { protocol: 'https:', host: 'here' });
    vi.stubGlobal('sessionStorage', { getItem: () => null });
    vi.stubGlobal('fetch', (path: string) => {
      if (path !== '/v1/policies/active') return Promise.resolve(Response.json({ items: [] }));
      return new Promise<Response>((resolve, reject) => {
        asked.push({ answer: (version) => resolve(Response.json({ version })), fail: () => reject(new TypeError('no network')) });
      });
    });
    page = new Console('secret');
  });
  afterEach(() => {
    page.end();
    vi.useRealTimers();
    vi.unstubAllGlobals();
  });

  function welcome(): void {
    PlayedWorker.newest.say({ type: 'welcome', version: 1, name: 'operator', role: 'operator', station: null, boot: 'b', at: 0 });
    PlayedWorker.newest.say({ type: 'snapshot', seq: 1, cells: [], invocations: [], escalations: [], grants: [], reviews: [], reviews_waiting: 0, events: [] });
  }

  it('is asked for once what is in the snapshot is, which may tell of another that came into force since the welcome', () => {
    PlayedWorker.newest.say({ type: 'welcome', version: 1, name: 'operator', role: 'operator', station: null, boot: 'b', at: 0 });
    expect(asked.length).toBe(0);
    welcome();
    expect(asked.length).toBe(1);
  });

  it('is what the newest request brought, whichever answer comes last', async () => {
    welcome();
    welcome();
    asked[1]?.answer('sha256:new');
    await vi.advanceTimersByTimeAsync(10);
    asked[0]?.answer('sha256:old');
    await vi.advanceTimersByTimeAsync(10);
    expect(page.policy?.version).toBe('sha256:new');
  });

  it('is asked for once at a time, however often the link came back meanwhile', async () => {
    for (let k = 0; k < 3; k += 1) welcome();
    asked.forEach(({ fail }) => fail());
    await vi.advanceTimersByTimeAsync(1_000);
    expect(asked.length).toBe(3);
    welcome(); // while the retry waits: it takes its place
    asked[3]?.answer('sha256:new');
    await vi.advanceTimersByTimeAsync(10_000);
    expect([asked.length, page.policy?.version]).toEqual([4, 'sha256:new']);
  });

  it('is asked for again until there is an answer', async () => {
    welcome();
    asked[0]?.fail();
    await vi.advanceTimersByTimeAsync(2_000);
    asked[1]?.answer('sha256:new');
    await vi.advanceTimersByTimeAsync(10_000);
    expect([asked.length, page.policy?.version]).toEqual([2, 'sha256:new']);
  });

  it('is not said to be in force from when another may be until it has come', async () => {
    welcome();
    asked[0]?.answer('sha256:old');
    await vi.advanceTimersByTimeAsync(10);
    expect(page.policyHolds).toBe(true);
    PlayedWorker.newest.say({ type: 'update', seq: 2, events: [event('policy_activated', {})] });
    asked[1]?.fail();
    await vi.advanceTimersByTimeAsync(1_000);
    expect([page.policy?.version, page.policyHolds]).toEqual(['sha256:old', false]);
    await vi.advanceTimersByTimeAsync(1_000);
    asked[2]?.answer('sha256:new');
    await vi.advanceTimersByTimeAsync(10);
    expect([page.policy?.version, page.policyHolds]).toEqual(['sha256:new', true]);
  });

  it('is not taken after signing out, nor asked for again', async () => {
    welcome();
    page.end();
    asked[0]?.answer('sha256:late');
    await vi.advanceTimersByTimeAsync(10_000);
    expect([asked.length, page.policy]).toEqual([1, null]);
  });

  it.each(['before', 'behind'])('is not asked for again by who signs out %s the failure', async (when) => {
    welcome();
    if (when === 'before') page.end();
    asked[0]?.fail();
    await vi.advanceTimersByTimeAsync(1_000);
    page.end();
    await vi.advanceTimersByTimeAsync(10_000);
    expect(asked.length).toBe(1);
  });
});

describe('the cell that is looked at', () => {
  let page: Console;
  const worker = (): PlayedWorker => PlayedWorker.newest;
  const described = (cell: string): void => worker().say({ type: 'scene', cell, scene, bodies: [], gauges: [] });

  beforeEach(() => {
    vi.useFakeTimers({ now: 0 });
    vi.stubGlobal('Worker', PlayedWorker);
    vi.stubGlobal('location', { protocol: 'https:', host: 'here' });
    vi.stubGlobal('sessionStorage', { getItem: () => null, setItem: () => undefined });
    vi.stubGlobal('fetch', () => Promise.resolve(Response.json({ items: [] })));
    page = new Console('secret');
    const cells = [cell(), cell({ id: 'workcell-2' }), cell({ id: 'workcell-3', online: false })];
    worker().up();
    worker().say({ type: 'snapshot', seq: 1, cells, invocations: [], escalations: [], grants: [], reviews: [], reviews_waiting: 0, events: [] });
  });
  afterEach(() => {
    page.end();
    vi.useRealTimers();
    vi.unstubAllGlobals();
  });

  it('is the present once the first picture of it has come, and not before', () => {
    expect([page.cell?.id, page.live, page.seen]).toEqual(['workcell-1', true, false]);
    described('workcell-1');
    expect(page.seen).toBe(false);
    worker().frame(0);
    expect(page.seen).toBe(true);
  });

  it('changes by nobody’s hand but the person’s: another that attaches takes nothing away from it', () => {
    worker().say({ type: 'update', seq: 2, cells: [cell({ id: 'alpha' })] });
    vi.advanceTimersByTime(100);
    expect([page.cells.length, page.cell?.id, page.stoppable]).toEqual([4, 'workcell-1', 'workcell-1']);
    page.select('alpha');
    expect(page.stoppable).toBe('alpha');
    page.select('gone');
    const known = (...ids: string[]): void => worker().say({ type: 'snapshot', seq: 3, cells: ids.map((id) => cell({ id })), invocations: [], escalations: [], grants: [], reviews: [], reviews_waiting: 0, events: [] });
    known('alpha', 'workcell-1');
    known('aleph', 'alpha', 'workcell-1');
    expect([page.cells[0]?.id, page.stoppable]).toEqual(['aleph', 'alpha']);
  });

  it('is no other once the server knows it no more, until the person chooses one, or it is back', () => {
    const known = (...ids: string[]): (string | null | undefined)[] => {
      worker().say({ type: 'snapshot', seq: 2, cells: ids.map((id) => cell({ id })), invocations: [], escalations: [], grants: [], reviews: [], reviews_waiting: 0, events: [] });
      return [page.cell?.id, page.gone, page.stoppable];
    };
    page.select('workcell-3');
    expect(known('alpha', 'workcell-1')).toEqual([undefined, 'workcell-3', 'workcell-3']);
    expect([page.live, page.seen]).toEqual([true, false]);
    expect(known('alpha', 'workcell-3')).toEqual(['workcell-3', null, 'workcell-3']);
    known('alpha');
    page.select('alpha');
    expect(known('alpha', 'workcell-3')).toEqual(['alpha', null, 'alpha']);
    expect(known()).toEqual([undefined, 'alpha', 'alpha']);
  });

  it('is drawn anew without the way that was planned before: of none that there is no more, a cell says nothing', () => {
    described('workcell-1');
    worker().say({ type: 'path', cell: 'workcell-1', invocation: 'inv_1', points: [[0, 0], [1, 1]] });
    expect(page.path?.invocation).toBe('inv_1');
    described('workcell-1'); // the link is back, and what ran has ended
    expect(page.path).toBe(null);
  });

  it('is never drawn as the one that was looked at before', () => {
    described('workcell-1');
    worker().frame(0);
    page.select('workcell-2');
    worker().frame(0); // on its way before the server knew
    expect([page.seen, page.scene]).toEqual([false, null]);
    described('workcell-2');
    worker().frame(0);
    expect(page.seen).toBe(true);
    page.select('workcell-3');
    expect([page.heard, page.seen, page.scene]).toEqual([false, false, null]);
  });

  it('forgets why a command was not obeyed with the cell that it was for: what becomes of the next ones is not heard while one looks away', () => {
    const jogged = (refused: string | null): void => worker().say({ type: 'jogged', cell: 'workcell-1', n: 1, refused });
    jogged('separation');
    expect(page.jogRefused).toBe('separation');
    page.select('workcell-2');
    jogged(null); // said once, when it changes
    page.select('workcell-1');
    expect(page.jogRefused).toBe(null);
  });

  it('is shown with what runs there, or else with what the open question there is about', () => {
    const asks = (id: string, second: number, of = {}): Invocation => invocation({ id, status: 'awaiting_approval', created_at: `2026-11-22T10:00:0${second}.000Z`, ...of });
    const about = (name: string, of = {}): Escalation => escalation({ id: `esc_${name}`, invocation: name, cell: 'workcell-1', ...of });
    const invocations = [asks('mug', 1), asks('driver', 2), asks('there', 3, { cell: 'workcell-2' }), invocation({ id: 'runs' })];
    const escalations = [about('mug'), about('driver'), about('there', { cell: 'workcell-2' })];
    const shown = (asked: string | null, busy: string | null): (string | undefined)[] => {
      worker().say({ type: 'snapshot', seq: 2, cells: [cell({ busy }), cell({ id: 'workcell-2', busy: null })], invocations, escalations, grants: [], reviews: [], reviews_waiting: 0, events: [] });
      page.asked = asked;
      return [page.session?.id, page.question?.id];
    };
    expect(shown('esc_mug', null)).toEqual(['mug', 'esc_mug']);
    expect(shown('esc_mug', 'runs')).toEqual(['runs', 'esc_mug']);
    expect(shown('esc_there', null)).toEqual(['driver', undefined]);
    expect([shown(null, null), shown('esc_gone', null)]).toEqual([['driver', undefined], ['driver', undefined]]);
    const turnedAway = asks('away', 5, { status: 'deferred', outcome: 'deferred', escalation: null });
    const withdrawn = asks('withdrawn', 4, { status: 'deferred', outcome: 'deferred', escalation: { id: 'esc_w', status: 'withdrawn', expires_at: null } });
    invocations.push(withdrawn, turnedAway);
    expect(shown(null, null)).toEqual(['withdrawn', undefined]);
  });
});

describe('the cell that a stop is for while no socket says which there are', () => {
  afterEach(() => {
    vi.useRealTimers();
    vi.unstubAllGlobals();
  });

  it('stays what it was when asking again fails, or another attaches', async () => {
    vi.useFakeTimers({ now: 0 });
    const answers: (() => Promise<Response>)[] = [
      () => Promise.resolve(Response.json({ items: [{ id: 'workcell-1' }] })),
      () => Promise.reject(new TypeError('no network')),
      () => Promise.resolve(Response.json({ items: [{ id: 'alpha' }, { id: 'workcell-1' }] })),
    ];
    vi.stubGlobal('Worker', PlayedWorker);
    vi.stubGlobal('location', { protocol: 'https:', host: 'here' });
    vi.stubGlobal('sessionStorage', { getItem: () => null, setItem: () => undefined });
    vi.stubGlobal('fetch', () => (answers.shift() ?? (() => Promise.reject(new TypeError('no network'))))());
    const page = new Console('secret');
    const stoppable: (string | null)[] = [];
    for (let k = 0; k < 3; k += 1) {
      await vi.advanceTimersByTimeAsync(1_000);
      stoppable.push(page.stoppable);
    }
    page.end();
    expect(stoppable).toEqual(['workcell-1', 'workcell-1', 'workcell-1']);
  });
});
