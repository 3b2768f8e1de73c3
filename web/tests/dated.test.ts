import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import { Link } from '../src/lib/socket/link';
import type { Down, Jog, Up } from '../src/lib/socket/messages';
import type { FromWorker, ToWorker } from '../src/lib/socket/worker';

/** A Worker that only keeps what it is told, and says what the test has it say. */
class PlayedWorker {
  static newest: PlayedWorker;
  told: ToWorker[] = [];
  onmessage: ((event: { data: FromWorker }) => void) | null = null;

  constructor() {
    PlayedWorker.newest = this;
  }
  postMessage(message: ToWorker): void {
    this.told.push(message);
  }
  say(message: Down): void {
    this.onmessage?.({ data: { is: 'message', message } });
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
    link = new Link('secret', { message: () => undefined, frame: () => undefined, health: () => undefined, refused: () => undefined });
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
