import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest';
import { Connection, type Health, type Listener } from '../src/lib/socket/connection';
import { retryMs, SILENT_MS, Watchdog } from '../src/lib/socket/watchdog';

/** A socket whose other end the test plays. */
class PlayedSocket {
  readyState = 0;
  binaryType = '';
  sent: Record<string, unknown>[] = [];
  onopen: (() => void) | null = null;
  onmessage: ((event: { data: string }) => void) | null = null;
  onclose: ((event: { code: number; reason: string }) => void) | null = null;

  send(text: string): void {
    this.sent.push(JSON.parse(text) as Record<string, unknown>);
  }
  close(): void {
    this.readyState = 3; // and no close event: a network that went away sends none
  }
  open(): void {
    this.readyState = 1;
    this.onopen?.();
  }
  say(message: object): void {
    this.onmessage?.({ data: JSON.stringify(message) });
  }
}

describe('the watchdog', () => {
  it('calls the link down within a second of silence', () => {
    const dog = new Watchdog(0);
    dog.heard(1_000);
    expect([dog.state(1_000 + SILENT_MS), dog.state(1_999)]).toEqual(['up', 'down']);
  });

  it('is not reassured by what an earlier socket said', () => {
    const dog = new Watchdog(0);
    dog.heard(1_000);
    dog.opened(1_100);
    expect(dog.state(1_150)).toBe('connecting');
  });

  it('waits longer after each failure, up to a bound', () => {
    const waits = [0, 1, 2, 3, 8, 50].map((attempt) => retryMs(attempt, 0.5));
    expect(waits).toEqual([250, 500, 1_000, 2_000, 4_000, 4_000]);
  });
});

describe('the connection', () => {
  let sockets: PlayedSocket[];
  let health: Health[];
  let refused: string[];
  let connection: Connection;
  let listener: Listener;
  let make: () => WebSocket;

  beforeEach(() => {
    vi.useFakeTimers({ now: 0 });
    sockets = [];
    health = [];
    refused = [];
    listener = { message: () => undefined, frame: () => undefined, health: (now) => health.push(now), refused: (why) => refused.push(why) };
    make = () => {
      const socket = new PlayedSocket();
      sockets.push(socket);
      return socket as unknown as WebSocket;
    };
    connection = new Connection('ws://here/v1/console', 'secret', listener, make, () => Date.now());
  });
  afterEach(() => {
    connection.end();
    vi.useRealTimers();
  });

  function welcome(socket: PlayedSocket | undefined): void {
    socket?.open();
    socket?.say({ type: 'welcome', version: 1, name: 'operator', role: 'operator', station: null, boot: 'b', at: 0 });
    socket?.say({ type: 'snapshot', seq: 42 });
  }

  it('signs in with its first frame, the token nowhere else', () => {
    sockets[0]?.open();
    expect(sockets[0]?.sent).toEqual([{ type: 'hello', token: 'secret', after: null }]);
  });

  it('says that a silent link is down within one second, without any close event', () => {
    welcome(sockets[0]);
    vi.advanceTimersByTime(500);
    expect(health.at(-1)?.state).toBe('up');
    vi.advanceTimersByTime(500);
    expect(health.at(-1)).toEqual({ state: 'down', rttMs: null, framesPerS: 0, why: '' });
  });

  it('leaves a black hole behind, comes back with what it saw last and watches again', () => {
    welcome(sockets[0]);
    connection.send({ type: 'watch', cells: ['workcell-1'] });
    vi.advanceTimersByTime(4_000);
    expect(sockets.length).toBe(2);
    welcome(sockets[1]);
    expect(sockets[1]?.sent).toEqual([
      { type: 'hello', token: 'secret', after: 42 },
      { type: 'ping', at_ms: -2 },
      { type: 'watch', cells: ['workcell-1'] },
    ]);
    vi.advanceTimersByTime(100);
    expect(health.at(-1)?.state).toBe('up');
  });

  it('takes no description for that of a cell which was chosen before, and is chosen again', () => {
    const shown: unknown[] = [];
    listener.message = (message) => message.type === 'scene' && shown.push(message.cell);
    welcome(sockets[0]);
    const described = (cell: string): void => sockets[0]?.say({ type: 'scene', cell, scene: {}, bodies: [], gauges: [] });
    const heard = (turn: number): void => sockets[0]?.say({ type: 'pong', at_ms: -turn });
    for (const cell of ['b', 'c', 'b']) connection.send({ type: 'watch', cells: [cell] });
    heard(1);
    described('b'); // what stands at its place is `c` from now on
    heard(2);
    described('c');
    heard(3);
    expect(shown).toEqual([]);
    described('b');
    expect(shown).toEqual(['b']);
    vi.advanceTimersByTime(100);
    expect(health.at(-1)?.rttMs).toBeNull();
  });

  it('hears nothing from a socket it has left', () => {
    welcome(sockets[0]);
    vi.advanceTimersByTime(4_000);
    sockets[0]?.say({ type: 'beat', n: 1, at: 0, seq: 42 });
    vi.advanceTimersByTime(900);
    expect(health.at(-1)?.state).not.toBe('up');
  });

  it('measures the line by its pings', () => {
    welcome(sockets[0]);
    vi.advanceTimersByTime(500);
    const ping = sockets[0]?.sent.find((word) => word['type'] === 'ping');
    vi.advanceTimersByTime(30);
    sockets[0]?.say({ type: 'pong', at_ms: ping?.['at_ms'] });
    vi.advanceTimersByTime(100);
    expect(health.at(-1)?.rttMs).toBe(30);
  });

  it('vouches for nothing before a snapshot of its own, however alive the line is', () => {
    welcome(sockets[0]);
    vi.advanceTimersByTime(4_000);
    sockets[1]?.open();
    sockets[1]?.say({ type: 'welcome', version: 1, name: 'operator', role: 'operator', boot: 'b', at: 0 });
    vi.advanceTimersByTime(100);
    expect(health.at(-1)?.state).toBe('connecting');
    sockets[1]?.say({ type: 'snapshot', seq: 43 });
    vi.advanceTimersByTime(100);
    expect(health.at(-1)?.state).toBe('up');
  });

  it('says that a line is late which brings beats, but the answer to no ping', () => {
    welcome(sockets[0]);
    const states: (string | undefined)[] = [];
    for (let at = 0; at < 2_400; at += 200) {
      vi.advanceTimersByTime(200);
      sockets[0]?.say({ type: 'beat', n: at, at: 0, seq: 42 });
      states.push(health.at(-1)?.state);
    }
    expect([states[4], states.at(-1)]).toEqual(['up', 'late']);
    sockets[0]?.say({ type: 'pong', at_ms: Date.now() });
    vi.advanceTimersByTime(100);
    expect(health.at(-1)?.state).toBe('up');
  });

  /** Lets time pass in steps of 100 ms; where it is `heard`, the server says something and answers what pings are old enough. */
  function restless(forMs: number, heard: (atMs: number) => boolean, lateMs: number): { states: (string | undefined)[]; changes: number } {
    const states: (string | undefined)[] = [];
    for (let at = 100; at <= forMs; at += 100) {
      vi.advanceTimersByTime(100);
      if (heard(at)) answer(lateMs);
      states.push(health.at(-1)?.state);
    }
    return { states, changes: states.filter((state, k) => k > 0 && state !== states[k - 1]).length };
  }

  function answer(lateMs: number): void {
    const sent = sockets[0]?.sent ?? [];
    sockets[0]?.say({ type: 'beat', n: 1, at: 0, seq: 42 });
    const old = sent.filter(({ type, at_ms }) => type === 'ping' && Date.now() - Number(at_ms) >= lateMs);
    for (const ping of old) {
      sent.splice(sent.indexOf(ping), 1);
      sockets[0]?.say({ type: 'pong', at_ms: ping['at_ms'] });
    }
  }

  it.each([1_100, 1_250, 1_400])('says of a line whose every answer is %d ms late that it is late, and does not take it back', (lateMs) => {
    welcome(sockets[0]);
    const { states, changes } = restless(8_000, () => true, lateMs);
    expect([states[0], states.at(-1), changes]).toEqual(['up', 'late', 1]);
  });

  it.each([800, 900])('says of a line that is heard every %d ms that it is late, until it holds', (everyMs) => {
    welcome(sockets[0]);
    const { states, changes } = restless(12_000, (at) => at % everyMs === 0, 0);
    expect([states.at(-1), changes <= 4]).toEqual(['late', true]);
    expect(new Set(states.slice(30))).toEqual(new Set(['late']));
    const after = restless(3_000, () => true, 0);
    expect([after.states.at(-1), after.changes]).toEqual(['up', 1]);
    vi.advanceTimersByTime(1_000);
    expect(health.at(-1)?.state).toBe('down'); // silence is told within a second all the same
  });

  it.each([
    [1_500, 'late', 1],
    [60_000, 'down', 2],
  ])('vouches for nothing that came while it stood still for %d ms, whatever lies there to be read', (ms, state, opened) => {
    welcome(sockets[0]);
    vi.advanceTimersByTime(500);
    answer(0);
    vi.advanceTimersByTime(100);
    expect(health.at(-1)?.state).toBe('up');
    vi.setSystemTime(Date.now() + ms);
    sockets[0]?.say({ type: 'beat', n: 2, at: 0, seq: 42 });
    vi.advanceTimersByTime(100);
    expect(health.at(-1)?.state).toBe(state);
    vi.advanceTimersByTime(500);
    expect(sockets.length).toBe(opened);
  });

  it('vouches for nothing after a sleep, in which its own clock stands still', () => {
    connection.end();
    connection = new Connection('ws://here/v1/console', 'secret', listener, make, () => performance.now());
    welcome(sockets[1]);
    vi.advanceTimersByTime(200);
    expect(health.at(-1)?.state).toBe('up');
    vi.setSystemTime(Date.now() + 60_000);
    vi.advanceTimersByTime(100);
    expect(health.at(-1)?.state).toBe('late');
    sockets[1]?.say({ type: 'pong', at_ms: sockets[1].sent.findLast(({ type }) => type === 'ping')?.['at_ms'] });
    vi.advanceTimersByTime(100);
    expect(health.at(-1)?.state).toBe('up');
  });

  it('never sends late what could not be sent', () => {
    connection.send({ type: 'jog', cell: 'c', lease: 'l', n: 1, base: [1, 0, 0], tool: [0, 0, 0], grip: null, beat: 0, since_ms: 0 });
    sockets[0]?.open();
    expect(sockets[0]?.sent.some((word) => word['type'] === 'jog')).toBe(false);
  });

  it('gives up on a token that is not valid', () => {
    sockets[0]?.open();
    sockets[0]?.onclose?.({ code: 4401, reason: '' });
    vi.advanceTimersByTime(10_000);
    expect([refused, sockets.length]).toEqual([['This token is not valid here, or not any more.'], 1]);
  });

  it('says of a token that no hello has room for what it says of any that is not valid', () => {
    connection.end();
    const long = new Connection('ws://here/v1/console', 'x'.repeat(513), listener, make, () => Date.now());
    vi.advanceTimersByTime(10_000);
    long.end();
    expect([refused, sockets.length]).toEqual([['This token is not valid here, or not any more.'], 1]);
  });
});
