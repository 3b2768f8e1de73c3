import { CLOSED, FINAL_CODES, LONGEST_TOKEN, SUBPROTOCOL, type Down, type Up } from './messages';
import { placeOf } from './frame';
import { LATE_MS, retryMs, Steady, Watchdog, type LinkState } from './watchdog';

const TICK_MS = 100;
const PING_MS = 500;

export interface Health {
  state: LinkState;
  rttMs: number | null;
  framesPerS: number;
  /** Why the server closed the last socket, in words; empty where it did not say, or another one stands. */
  why: string;
}

/** What the connection tells whoever started it. */
export interface Listener {
  message(message: Down): void;
  frame(buffer: ArrayBuffer): void;
  health(health: Health): void;
  /** The server will not have this token; no further attempt is made. */
  refused(why: string): void;
}

/**
 * One console's socket, kept open: hello, pings, watchdog, and another socket when one falls silent.
 *
 * A socket whose network went away may never report its close, so silence is judged by the clock, and a spent socket
 * is detached and left to itself. Runs in a Worker, where a hidden page's timers are not slowed down.
 */
export class Connection {
  private socket: WebSocket | null = null;
  private readonly dog: Watchdog;
  private readonly steady = new Steady();
  private attempt = 0;
  private retryAtMs: number | null = null;
  private pingedMs = 0;
  /** When this was last given a turn, by either clock: in a sleep the wall clock alone goes on. */
  private turn = { ms: 0, wallMs: 0 };
  /** When the pings were sent that wait for an answer, oldest first: it comes in line behind everything else. */
  private unanswered: number[] = [];
  /** Whether this socket's snapshot has come: until then, what is known is what an earlier one said. */
  private synced = false;
  private rttMs: number | null = null;
  private frames: number[] = [];
  private lastSeq: number | null = null;
  private why = '';
  private boot: string | null = null;
  private watched: string[] = [];
  /** How often something else was watched, and for which time that is known to have been heard. */
  private watch = { asked: 0, heard: 0 };
  private readonly timer: ReturnType<typeof setInterval>;

  constructor(
    private readonly url: string,
    private readonly token: string,
    private readonly listener: Listener,
    private readonly make: (url: string, protocol: string) => WebSocket = (address, protocol) => new WebSocket(address, protocol),
    private readonly now: () => number = () => performance.now(),
  ) {
    this.dog = new Watchdog(this.now());
    this.turn = { ms: this.now(), wallMs: Date.now() };
    this.timer = setInterval(() => this.tick(), TICK_MS);
    if (token.length > LONGEST_TOKEN) this.closed(4401, '');
    else this.open();
  }

  /** Sends a message if the socket is open; a message that cannot be sent now is dropped, never sent late. */
  send(message: Up): void {
    if (message.type === 'watch') this.ask(message.cells);
    if (this.socket?.readyState === 1) this.socket.send(JSON.stringify(message));
  }

  end(): void {
    clearInterval(this.timer);
    this.leave();
  }

  /**
   * Takes what is told of cells for an answer to a `watch` that was said before this one, until that is known to be heard:
   * frames bear the place of a cell in the list, and another one stood there. A ping in front of it that bears its number, and no time, tells.
   */
  private ask(cells: string[]): void {
    this.watched = cells;
    this.watch = { ...this.watch, asked: this.watch.asked + 1 };
    this.send({ type: 'ping', at_ms: -this.watch.asked });
  }

  private open(): void {
    this.retryAtMs = null;
    this.unanswered = [];
    this.rttMs = null;
    this.synced = false;
    this.dog.opened(this.now());
    const socket = this.make(this.url, SUBPROTOCOL);
    socket.binaryType = 'arraybuffer';
    socket.onopen = () => this.send({ type: 'hello', token: this.token, after: this.lastSeq });
    socket.onmessage = (event: MessageEvent<string | ArrayBuffer>) => this.come(event.data);
    socket.onclose = (event) => this.closed(event.code, event.reason);
    this.socket = socket;
  }

  /** Lets go of the socket without waiting for its close, which may never come. */
  private leave(): void {
    const socket = this.socket;
    this.socket = null;
    if (socket === null) return;
    socket.onopen = socket.onmessage = socket.onclose = null;
    socket.close();
  }

  private closed(code: number, reason: string): void {
    this.leave();
    if (FINAL_CODES.has(code)) {
      clearInterval(this.timer);
      this.listener.refused(CLOSED[code] ?? reason);
      return;
    }
    this.why = CLOSED[code] ?? '';
    this.later();
  }

  private later(): void {
    this.retryAtMs = this.now() + retryMs(this.attempt, Math.random());
    this.attempt += 1;
  }

  /** What lies here unread after this stood still came meanwhile: a socket that was silent for too long by then is left, and that with it. */
  private come(data: string | ArrayBuffer): void {
    if (this.stoodStillMs(this.now()) > 0) this.tick();
    if (this.socket !== null) this.take(data);
  }

  private take(data: string | ArrayBuffer): void {
    const now = this.now();
    this.dog.heard(now);
    if (typeof data !== 'string') {
      if (placeOf(data) === 0) this.frames.push(now); // of the cell that is looked at
      this.listener.frame(data);
      return;
    }
    const message = JSON.parse(data) as Down;
    if (message.type === 'pong') {
      this.answered(message.at_ms, now);
      return;
    }
    if (this.toAnEarlierWatch(message)) return;
    if (message.type === 'welcome') this.welcomed(message.boot);
    if (message.type === 'snapshot') this.synced = true;
    if (message.type === 'snapshot' || message.type === 'update') this.lastSeq = message.seq;
    this.listener.message(message);
  }

  private answered(atMs: number, now: number): void {
    if (atMs < 0) {
      this.watch = { ...this.watch, heard: -atMs };
      return;
    }
    this.rttMs = now - atMs;
    this.unanswered = this.unanswered.filter((at) => at > atMs);
  }

  private toAnEarlierWatch({ type }: Down): boolean {
    return (type === 'scene' || type === 'path') && this.watch.heard !== this.watch.asked;
  }

  private welcomed(boot: string): void {
    this.attempt = 0;
    this.why = '';
    if (this.boot !== null && this.boot !== boot) this.lastSeq = null;
    this.boot = boot;
    if (this.watched.length > 0) this.send({ type: 'watch', cells: this.watched });
  }

  /** How long this was given no turn, as it is frozen or the computer sleeps; 0 where nothing that came meanwhile is late. */
  private stoodStillMs(now: number): number {
    const ms = Math.max(now - this.turn.ms, Date.now() - this.turn.wallMs);
    return ms > LATE_MS ? ms : 0;
  }

  private tick(): void {
    const now = this.now();
    const stillMs = this.stoodStillMs(now);
    this.turn = { ms: now, wallMs: Date.now() };
    if (this.socket !== null && this.dog.spent(now)) {
      this.leave();
      this.later();
    }
    if (this.retryAtMs !== null && now >= this.retryAtMs) this.open();
    if (stillMs > 0 || now - this.pingedMs >= PING_MS) {
      this.pingedMs = now;
      if (this.synced) this.unanswered.push(now - stillMs); // until it is answered, what comes may be as old
      this.send({ type: 'ping', at_ms: now });
    }
    this.frames = this.frames.filter((at) => now - at < 1_000);
    const state = this.steady.take(this.state(now), now);
    this.listener.health({ state, rttMs: state === 'up' ? this.rttMs : null, framesPerS: this.frames.length, why: this.why });
  }

  private state(now: number): LinkState {
    const heard = this.socket === null ? 'down' : this.dog.state(now);
    if (heard !== 'up') return heard;
    if (!this.synced) return 'connecting';
    // An answer that came late says how old everything is that came with it.
    return Math.max(now - (this.unanswered[0] ?? now), this.rttMs ?? 0) > LATE_MS ? 'late' : 'up';
  }
}
