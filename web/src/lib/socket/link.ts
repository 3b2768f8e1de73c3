import workerUrl from './worker?worker&url';
import type { Health } from './connection';
import { readFrame, type PoseFrame } from './frame';
import type { Age, Down, Jog, Up } from './messages';
import { LATE_MS, Steady } from './watchdog';
import type { FromWorker, ToWorker } from './worker';

/** What a page learns from its link. */
export interface LinkListener {
  /** `cameMs`: when it came to this computer, by the page's clock. */
  message(message: Down, cameMs: number): void;
  frame(frame: PoseFrame): void;
  health(health: Health): void;
  refused(why: string): void;
  /** How long what has come will have waited by the time it is drawn; 0 where nothing waits. */
  behindMs(): number;
}

/** Why what comes is late where it is not the line. */
export const BUSY = 'This computer is too busy.';

/** The Worker is silent for this long: it is the link that cannot be vouched for. */
export const WORKER_SILENT_MS = 600;

/** One that spoke and is silent for so long has ended: another takes its place. */
export const WORKER_GONE_MS = 5_000;

const LOOK_MS = 200;
/** What counts of the time between two looks: a page that was busy has not looked, and what the Worker said meanwhile lies before it. */
const LOOKED_MS = 250;

/** A Worker that did not come is asked for again after this long. */
const AGAIN_MS = 1_000;

/** So many frames make one acknowledgement: half the words, and the server lets twice as many be under way. */
const FRAMES_PER_ACK = 2;

/** The page's end of the socket Worker. Beats and frames are acknowledged when the page took them, so a busy page gets fewer. */
export class Link {
  private worker: Worker;
  private again: ReturnType<typeof setTimeout> | undefined;
  private silentMs = 0;
  private lookedMs = performance.now();
  private framesTaken = 0;
  /** What is watched, for a Worker that has to be told of it. */
  private watched: Up | null = null;
  private beat = { n: 0, takenMs: 0 };
  /** How long what the Worker says takes at least until it is taken here, by two clocks of which each began by itself. */
  private leastMs = Infinity;
  private behind = false;
  private readonly steady = new Steady();
  private readonly timer: ReturnType<typeof setInterval>;

  constructor(private readonly token: string, private readonly listener: LinkListener) {
    this.worker = this.begin();
    this.timer = setInterval(() => this.look(), LOOK_MS);
  }

  /** Its script is fetched by itself: one that did not come is asked for again, as a socket is. */
  private begin(): Worker {
    const worker = new Worker(scriptUrl(workerUrl) as string, { type: 'module', name: 'reins-link' });
    worker.onmessage = (event: MessageEvent<readonly FromWorker[]>) => this.takeAll(worker, event.data);
    this.leastMs = Infinity;
    worker.onerror = () => (this.again = setTimeout(() => (this.worker = this.begin()), AGAIN_MS));
    const url = `${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/v1/console`;
    worker.postMessage({ do: 'open', url, token: this.token } satisfies ToWorker);
    if (this.watched !== null) worker.postMessage({ do: 'send', message: this.watched } satisfies ToWorker);
    return worker;
  }

  send(message: Up): void {
    if (message.type === 'watch') this.watched = message;
    this.post({ do: 'send', message });
  }

  /** Says a hold-to-run command, and of when it is: one that a slow line held back moves nothing. */
  jog(command: Jog): void {
    this.send({ ...command, ...this.heard() });
  }

  /** Of when what is said now is. */
  heard(): Age {
    return { beat: this.beat.n, since_ms: performance.now() - this.beat.takenMs };
  }

  end(): void {
    clearInterval(this.timer);
    clearTimeout(this.again);
    this.post({ do: 'end' });
    setTimeout(() => this.worker.terminate(), 100);
  }

  private post(message: ToWorker): void {
    this.worker.postMessage(message);
  }

  private takeAll(worker: Worker, all: readonly FromWorker[]): void {
    this.silentMs = 0;
    worker.onerror = null; // it is there
    for (const said of all) {
      try {
        this.take(said);
      } catch (error) {
        queueMicrotask(() => { throw error; }); // told as what nobody caught is; what came behind it is taken all the same
      }
    }
    worker.postMessage({ do: 'took' } satisfies ToWorker);
  }

  private take(said: FromWorker): void {
    switch (said.is) {
      case 'message':
        this.acknowledge(said.message);
        this.listener.message(said.message, this.cameMs(said.atMs));
        break;
      case 'frame': {
        const frame = readFrame(said.buffer);
        this.acknowledgeFrame(frame);
        this.listener.frame(frame);
        break;
      }
      case 'health':
        this.listener.health(this.aged(said.health, said.atMs));
        break;
      case 'refused':
        this.listener.refused(said.why);
    }
  }

  /** When the Worker said something, by the page's clock: as if what was taken quickest had come at once. */
  private cameMs(atMs: number): number {
    this.leastMs = Math.min(this.leastMs, performance.now() - atMs);
    return atMs + this.leastMs;
  }

  /** A page that is too busy to take what has come, or to draw it, shows what was so, however well the server is heard. */
  private aged(health: Health, atMs: number): Health {
    const nowMs = performance.now();
    const oldMs = Math.max(nowMs - this.cameMs(atMs), this.listener.behindMs());
    // Once behind it has to catch up well, or the answers would come and go under a finger.
    const own = this.steady.take(oldMs > (this.behind ? LATE_MS / 2 : LATE_MS) ? 'late' : 'up', nowMs);
    this.behind = own !== 'up';
    return health.state === 'up' && own !== 'up' ? { ...health, state: own, rttMs: null, why: BUSY } : health;
  }

  private acknowledgeFrame(frame: PoseFrame): void {
    this.framesTaken += 1;
    if (this.framesTaken % FRAMES_PER_ACK === 0) this.send({ type: 'ack', cell: frame.cell, frame: frame.frame });
  }

  private acknowledge(message: Down): void {
    if (message.type === 'welcome') this.beat = { n: 0, takenMs: 0 }; // those before may be another start's
    else if (message.type === 'beat') this.took(message.n);
    else if (message.type === 'update' && message.beat !== undefined) this.took(message.beat);
  }

  private took(beat: number): void {
    this.beat = { n: beat, takenMs: performance.now() };
    this.send({ type: 'ack', beat });
  }

  private look(): void {
    const nowMs = performance.now();
    this.silentMs += Math.min(LOOKED_MS, nowMs - this.lookedMs);
    this.lookedMs = nowMs;
    if (this.silentMs > WORKER_SILENT_MS) {
      this.listener.health({ state: 'down', rttMs: null, framesPerS: 0, why: '' });
    }
    // What has not spoken yet may still be on its way here.
    if (this.silentMs > WORKER_GONE_MS && this.worker.onerror === null) this.replace();
  }

  private replace(): void {
    this.worker.onmessage = null;
    this.worker.terminate();
    this.silentMs = 0;
    this.worker = this.begin();
  }
}

interface ScriptPolicy {
  createScriptURL(url: string): unknown;
}
interface ScriptPolicies {
  createPolicy(name: string, rules: { createScriptURL(url: string): string }): ScriptPolicy;
}

let policy: ScriptPolicy | null = null; // one name may be registered once

/** A Worker's address has to be a TrustedScriptURL where Trusted Types are enforced; only our own origin passes. */
function scriptUrl(path: string): unknown {
  const policies = (globalThis as { trustedTypes?: ScriptPolicies }).trustedTypes;
  if (policies === undefined) return path;
  policy ??= policies.createPolicy('reins-worker', {
    createScriptURL(url) {
      if (new URL(url, location.href).origin !== location.origin) throw new TypeError('a Worker comes from here alone');
      return url;
    },
  });
  return policy.createScriptURL(path);
}
