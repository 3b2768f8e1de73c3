import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import type { Health } from '../src/lib/socket/connection';
import { BUSY, Link } from '../src/lib/socket/link';
import type { Down, Jog, Up } from '../src/lib/socket/messages';
import type { FromWorker, ToWorker } from '../src/lib/socket/worker';

/** A Worker that only keeps what it is told, and says what the test has it say. */
class PlayedWorker {
  static newest: PlayedWorker;
  told: ToWorker[] = [];
  onmessage: ((event: { data: FromWorker[] }) => void) | null = null;
  onerror: (() => void) | null = null;

  constructor() {
    PlayedWorker.newest = this;
  }
  postMessage(message: ToWorker): void {
    this.told.push(message);
  }
  say(...messages: Down[]): void {
    this.onmessage?.({ data: messages.map((message) => ({ is: 'message', message, atMs: performance.now() })) });
  }
  /** Says how the link is, as it was at that time by its own clock. */
  feels(atMs: number, state: Health['state'] = 'up'): void {
    this.onmessage?.({ data: [{ is: 'health', health: { state, rttMs: 3, framesPerS: 30, why: '' }, atMs }] });
  }
  terminate(): void {
    this.onmessage = null;
  }
}

const FORWARD: Jog = { type: 'jog', cell: 'c', lease: 'l', n: 1, base: [0.1, 0, 0], tool: [0, 0, 0], grip: null };
const WELCOME: Down = { type: 'welcome', version: 1, name: 'o', role: 'operator', station: null, boot: 'b', at: 0 };

describe('a hold-to-run command', () => {
  let link: Link;

  beforeEach(() => {
    vi.useFakeTimers({ now: 5_000 });
    vi.stubGlobal('Worker', PlayedWorker);
    vi.stubGlobal('location', { protocol: 'http:', host: 'here', href: 'http://here/', origin: 'http://here' });
    link = new Link('secret', { message: () => undefined, frame: () => undefined, health: () => undefined, refused: () => undefined, behindMs: () => 0 });
  });
  afterEach(() => {
    link.end();
    vi.unstubAllGlobals();
    vi.useRealTimers();
  });

  function jogged(): Up | undefined {
    link.jog(FORWARD);
    const said = PlayedWorker.newest.told.at(-1);
    return said?.do === 'send' ? said.message : undefined;
  }

  it('says which beat had come, and how long before', () => {
    PlayedWorker.newest.say({ type: 'beat', n: 7, at: 0, seq: 1 });
    vi.advanceTimersByTime(120);
    expect(jogged()).toEqual({ ...FORWARD, beat: 7, since_ms: 120 });
    PlayedWorker.newest.say({ type: 'update', seq: 2, beat: 8 });
    expect(jogged()).toEqual({ ...FORWARD, beat: 8, since_ms: 0 });
  });

  it('names no beat of an earlier connection, nor one where none has come', () => {
    expect(jogged()).toMatchObject({ beat: 0 });
    PlayedWorker.newest.say({ type: 'beat', n: 7, at: 0, seq: 1 });
    PlayedWorker.newest.say(WELCOME);
    expect(jogged()).toMatchObject({ beat: 0 });
  });
});

describe('a page that is slow to take what has come', () => {
  const ITS_CLOCK_MS = 1_700;
  let link: Link;
  let seen: Health[];
  let told: Down[];
  let came: number[];
  let behindMs: number;

  beforeEach(() => {
    vi.useFakeTimers({ now: 5_000 });
    vi.stubGlobal('Worker', PlayedWorker);
    vi.stubGlobal('location', { protocol: 'http:', host: 'here', href: 'http://here/', origin: 'http://here' });
    [seen, told, came, behindMs] = [[], [], [], 0];
    link = new Link('secret', { message: (message, cameMs) => [told.push(message), came.push(cameMs)], frame: () => undefined, health: (health) => seen.push(health), refused: () => undefined, behindMs: () => behindMs });
  });
  afterEach(() => {
    link.end();
    vi.restoreAllMocks();
    vi.unstubAllGlobals();
    vi.useRealTimers();
  });

  /** What was said so long ago is taken now. */
  function taken(agoMs: number, state: Health['state'] = 'up'): string | undefined {
    PlayedWorker.newest.feels(performance.now() - ITS_CLOCK_MS - agoMs, state);
    return seen.at(-1)?.state;
  }

  it('shows nothing as the present that waited for it for more than a second', () => {
    expect(taken(0)).toBe('up');
    expect(taken(900)).toBe('up');
    expect(taken(1_100)).toBe('late');
    expect(seen.at(-1)).toMatchObject({ rttMs: null, why: BUSY });
    expect(taken(10)).toBe('up');
    expect(taken(4_000, 'down')).toBe('down');
  });

  it('shows nothing as the present where what has come waits for longer to be drawn', () => {
    taken(0);
    behindMs = 900;
    expect(taken(0)).toBe('up');
    behindMs = 1_100;
    expect(taken(0)).toBe('late');
    expect(seen.at(-1)).toMatchObject({ rttMs: null, why: BUSY });
    behindMs = 900;
    expect(taken(0)).toBe('late'); // it would not last
    behindMs = 400;
    expect(taken(0)).toBe('up');
  });

  it('knows when what it takes came', () => {
    taken(0);
    PlayedWorker.newest.onmessage?.({ data: [{ is: 'message', message: WELCOME, atMs: performance.now() - ITS_CLOCK_MS - 700 }] });
    expect(came).toEqual([performance.now() - 700]);
  });

  it('is no page that comes and goes', () => {
    taken(0);
    for (const agoMs of [1_500, 0, 1_500]) taken(agoMs);
    vi.advanceTimersByTime(500);
    expect(taken(0)).toBe('late');
    vi.advanceTimersByTime(2_100);
    expect(taken(0)).toBe('up');
  });

  it('does not call the link down because it was itself too busy to hear of it', () => {
    const now = performance.now.bind(performance);
    vi.spyOn(performance, 'now').mockImplementation(() => now() + 5_000); // it hung for so long
    vi.advanceTimersToNextTimer();
    expect(seen).toEqual([]);
    vi.advanceTimersByTime(1_000); // and then it did not: nobody says anything any more
    expect(seen.at(-1)?.state).toBe('down');
  });

  it('has another Worker hold the socket, and watch the same, where the one that spoke has ended', () => {
    const first = PlayedWorker.newest;
    vi.advanceTimersByTime(10_000);
    expect(PlayedWorker.newest).toBe(first); // its script may be on its way
    taken(0);
    link.send({ type: 'watch', cells: ['c'] });
    vi.advanceTimersByTime(4_000);
    expect([PlayedWorker.newest, seen.at(-1)?.state]).toEqual([first, 'down']);
    vi.advanceTimersByTime(2_000);
    expect(PlayedWorker.newest).not.toBe(first);
    expect([first.onmessage, seen.at(-1)?.state]).toEqual([null, 'down']);
    expect(PlayedWorker.newest.told).toMatchObject([{ do: 'open', token: 'secret' }, { do: 'send', message: { type: 'watch', cells: ['c'] } }]);
    expect(taken(0)).toBe('up');
  });

  it('says that it has taken what came together, also where one of that is none', () => {
    const [uncaught, before] = [vi.fn(), PlayedWorker.newest.told.length];
    vi.stubGlobal('queueMicrotask', uncaught);
    PlayedWorker.newest.say(WELCOME, null as unknown as Down, { type: 'beat', n: 7, at: 0, seq: 1 });
    expect(told.map(({ type }) => type)).toEqual(['welcome', 'beat']);
    expect(uncaught).toHaveBeenCalledOnce();
    expect(PlayedWorker.newest.told.slice(before)).toEqual([{ do: 'send', message: { type: 'ack', beat: 7 } }, { do: 'took' }]);
  });
});
