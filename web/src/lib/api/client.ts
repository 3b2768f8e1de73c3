import { sentence } from '../format/quoted';
import type { Age } from '../socket/messages';
import type {
  Capability,
  Cell,
  Checkpoint,
  Comparison,
  Control,
  Escalation,
  EventList,
  Grant,
  Invocation,
  List,
  LogEvent,
  Params,
  PolicySet,
  Problem,
  Review,
  ReviewVerdict,
  Shadow,
  Telemetry,
  Verdict,
  Verification,
  Version,
  VersionList,
  Watched,
} from './documents';
import { Gate } from './gate';

/** The server's refusal of a request, or `unreachable` where no answer came. */
export class ApiError extends Error {
  constructor(
    readonly problem: Problem,
  ) {
    super(sentence(problem.detail));
  }

  get code(): string {
    return this.problem.code;
  }
}

/** Why something was refused, in words: policy's own reasons are those that help. */
export function refusedWords(error: unknown): string {
  if (!(error instanceof Error)) return String(error);
  const reasons = error instanceof ApiError ? (error.problem.reasons ?? []) : [];
  return [error.message, ...reasons.map(({ message }) => sentence(message))].join(' ');
}

/** The code of an answer that is no problem document of the server's: a proxy's, for instance. */
export const UNKNOWN = 'unknown';
const UNREACHABLE: Problem = { title: 'No answer', status: 0, detail: 'The server did not answer.', code: 'unreachable' };
/** What is said where no answer came to what was to change something: that may be late, or lost, alone. */
export const UNTOLD = 'No answer from the server: it is not known whether this arrived.';
const PATIENCE_MS = 10_000;
const LONG_PATIENCE_MS = 120_000;
/** A browser opens six connections to a server, for all of its tabs; a request beyond them waits, whatever it says. */
const AT_ONCE = 3;
/** What restrains has connections of its own, and leaves one for the stop. */
const RESTRAINTS_AT_ONCE = 2;

type Method = 'GET' | 'POST' | 'PUT' | 'DELETE';

/** How a request is made. */
interface How {
  /** It may take a while, and waits for others that may. */
  long?: boolean;
  /** It stops, ends or takes back something, and waits for nothing that is read. */
  restrains?: boolean;
  /** Ended by whoever does not want the answer any more. */
  until?: AbortSignal | undefined;
}

export interface Answer {
  decision: 'approve' | 'deny';
  digest: string;
  params?: Params;
  code?: string;
  comment?: string;
  /** More of the same, allowed in advance with the last approval. */
  grant?: Offer;
}

/** A standing grant: for the object or the task of the proposal, or for whatever of the capability comes in that time. */
export interface Offer {
  scope: 'object' | 'task' | 'time';
  minutes: number;
  /** Which, where the proposal does not name it: what its cell holds. */
  object?: string;
}

/** The HTTP contract as calls. Every call raises `ApiError` unless it was answered with success. */
export class Api {
  private readonly few = new Gate(AT_ONCE);
  private readonly one = new Gate(1);
  private readonly restraints = new Gate(RESTRAINTS_AT_ONCE);

  constructor(
    private readonly token: string,
    private readonly fetcher: typeof fetch = (input, init) => fetch(input, init),
    /** What the server said last, and how long ago: by its own clock it is told until when an answer is waited for. */
    private readonly heard: () => Age = () => ({ beat: 0, since_ms: 0 }),
  ) {}

  get<T>(path: string, until?: AbortSignal): Promise<T> {
    return this.call<T>('GET', path, undefined, { until });
  }

  call<T>(method: Method, path: string, body?: unknown, how: How = {}): Promise<T> {
    return this.inTurn(how, () => this.send(method, path, body, how, jsonOf<T>));
  }

  /** What takes long is asked for one by one, and all together leave a browser's connections free for the stop. */
  private inTurn<T>({ long = false, restrains = false }: How, call: () => Promise<T>): Promise<T> {
    if (restrains) return this.restraints.through(call);
    const asked = (): Promise<T> => this.few.through(call);
    return long ? this.one.through(asked) : asked();
  }

  /** Where a line holds a request back, no end of its connection tells the server in time that nobody waits any more. */
  private headers(how: How): Record<string, string> {
    const bearer = { Authorization: `Bearer ${this.token}` };
    const { beat, since_ms } = this.heard();
    if (beat === 0 || how.long === true) return bearer;
    return { ...bearer, 'Reins-Patience': `${beat} ${Math.round(since_ms + PATIENCE_MS)}` };
  }

  /** A connection is taken until the answer is read to its end. */
  private async send<T>(method: Method, path: string, body: unknown, how: How, read: (response: Response) => Promise<T>): Promise<T> {
    const headers = { ...(body === undefined ? {} : { 'Content-Type': 'application/json' }), ...this.headers(how) };
    const patience = AbortSignal.timeout(how.long === true ? LONG_PATIENCE_MS : PATIENCE_MS);
    const signal = how.until === undefined ? patience : AbortSignal.any([patience, how.until]);
    let response: Response;
    try {
      signal.throwIfAborted(); // whoever wanted it may have gone while it waited for its turn
      response = await this.fetcher(path, { method, headers, body: body === undefined ? null : JSON.stringify(body), signal, cache: 'no-store' });
    } catch {
      throw new ApiError(method === 'GET' || path === '/v1/check' ? UNREACHABLE : { ...UNREACHABLE, detail: UNTOLD });
    }
    if (!response.ok) throw new ApiError(await problemOf(response));
    return read(response);
  }

  health = (): Promise<{ status: string; broken: Record<string, string | null> }> => this.get('/healthz');
  /** The page that the console begins with. */
  page = (): Promise<string> => this.inTurn({}, () => this.send('GET', '/', undefined, {}, (response) => response.text()));
  cells = (): Promise<List<Cell>> => this.get('/v1/cells');
  capabilities = (): Promise<List<Capability>> => this.get('/v1/capabilities');
  policy = (): Promise<PolicySet> => this.get('/v1/policies/active');
  watched = (): Promise<Watched> => this.get('/v1/policies/active/watch');
  versions = (limit: number): Promise<VersionList> => this.get(`/v1/policies?limit=${limit}`);
  version = (digest: string): Promise<Version> => this.get(`/v1/policies/${seg(digest)}`);
  policyFiles = (digest: string): Promise<{ files: Record<string, string>; promises: string | null }> => this.get(`/v1/policies/${seg(digest)}/files`);
  /** Compared by proof, which may take a while. */
  comparison = (digest: string, until?: AbortSignal): Promise<Comparison> =>
    this.call('GET', `/v1/policies/${seg(digest)}/diff`, undefined, { long: true, until });
  propose = (files: Record<string, string>, why: string): Promise<Version> =>
    this.call('POST', '/v1/policies', { files, why }, { long: true });
  /** `before` is what it was compared with: in the place of another one it is another change. */
  activate = (digest: string, why: string, before: string | null): Promise<Version> =>
    this.call('POST', `/v1/policies/${seg(digest)}/activate`, before === null ? { why } : { why, before }, { long: true });
  shadow = (digest: string): Promise<Shadow> => this.get(`/v1/policies/${seg(digest)}/shadow`);
  setShadow = (digest: string, on: boolean, why: string): Promise<Shadow> =>
    this.call('POST', `/v1/policies/${seg(digest)}/shadow`, { on, why }, { long: true });
  trace = (id: string): Promise<List<LogEvent>> => this.get(`/v1/invocations/${seg(id)}/trace`);
  invocation = (id: string): Promise<Invocation> => this.get(`/v1/invocations/${seg(id)}`);

  /** `as` is the agent whose permissions apply; an operator checks an edit on the agent's behalf. */
  check = (proposal: { capability: string; params: Params; cell?: string | null; agent?: string; mode?: string; metadata?: Params }): Promise<Verdict> =>
    this.call('POST', '/v1/check', proposal);

  resolve = (id: string, answer: Answer): Promise<Escalation> =>
    this.call('POST', `/v1/escalations/${seg(id)}/resolve`, answer, { restrains: answer.decision === 'deny' });
  acknowledge = (id: string): Promise<Escalation> => this.call('POST', `/v1/escalations/${seg(id)}/acknowledge`);
  revoke = (id: string): Promise<Grant> => this.call('POST', `/v1/grants/${seg(id)}/revoke`, undefined, { restrains: true });
  reviews = (query: URLSearchParams): Promise<List<Review>> => this.get(`/v1/reviews?${query}`);
  reviewsOf = (invocation: string): Promise<List<Review>> => this.get(`/v1/reviews?invocation=${seg(invocation)}`);
  review = (id: string, verdict: ReviewVerdict, note: string): Promise<Review> =>
    this.call('POST', `/v1/reviews/${seg(id)}/resolve`, note === '' ? { verdict } : { verdict, note });

  /** Waits for nothing else. */
  estop = (cell: string): Promise<Cell> =>
    this.send('POST', `/v1/cells/${seg(cell)}/estop`, undefined, {}, jsonOf<Cell>);
  /** The first step of a reset; the answer's `arming` bears the code for the second. */
  armReset = (cell: string): Promise<Cell> => this.call('POST', `/v1/cells/${seg(cell)}/reset`, { step: 'arm' });
  confirmReset = (cell: string, code: string): Promise<Cell> =>
    this.call('POST', `/v1/cells/${seg(cell)}/reset`, { step: 'confirm', code });
  /** `before` is what it was compared with: under another profile by now, it is another change. */
  setProfile = (cell: string, profile: string, before: string): Promise<Cell> =>
    this.call('PUT', `/v1/cells/${seg(cell)}/profile`, { profile, before });

  events = (query: URLSearchParams, until?: AbortSignal): Promise<EventList> => this.get(`/v1/audit/events?${query}`, until);
  invocations = (query: URLSearchParams, until?: AbortSignal): Promise<List<Invocation>> => this.get(`/v1/invocations?${query}`, until);
  checkpoint = (): Promise<Checkpoint> => this.get('/v1/audit/checkpoint');
  /** Recomputes the whole log, which may take a while. */
  verify = (): Promise<Verification> => this.call('GET', '/v1/audit/verify', undefined, { long: true });
  telemetry = (id: string, part = 1, until?: AbortSignal): Promise<Telemetry> =>
    this.call('GET', `/v1/audit/telemetry/${seg(id)}?part=${part}`, undefined, { long: true, until });
  telemetryFile = (id: string, part = 1): Promise<Blob> =>
    this.inTurn({ long: true }, () => this.send('GET', `/v1/audit/telemetry/${seg(id)}/mcap?part=${part}`, undefined, { long: true }, blobOf));

  restrain = (id: string, word: 'pause' | 'stop' | 'cancel'): Promise<Invocation> =>
    this.call('POST', `/v1/invocations/${seg(id)}/${word}`, undefined, { restrains: true });
  /** What lets something move counts for what was seen, up to the event `after`: a link may hold it back for long. */
  loosen = (id: string, word: 'resume' | 'rollback', after: number): Promise<Invocation> =>
    this.call('POST', `/v1/invocations/${seg(id)}/${word}`, { after });

  /** `after` is what was seen: what a link holds back ends no pause that came since. */
  takeOver = (id: string, after: number): Promise<Control> => this.call('POST', `/v1/invocations/${seg(id)}/takeover`, { after });
  /** Takes the controls of a cell in which nothing runs. */
  takeCell = (cell: string, after: number): Promise<Control> => this.call('POST', `/v1/cells/${seg(cell)}/takeover`, { after });
  /**
   * `lease` is what it was driven by, `after` what was seen: what a link holds back hands nothing back that was taken, or paused, since.
   * `digest` is of the refusal that was read: to go on approves what that asks people about.
   */
  release = (id: string, then: 'resume' | 'rollback' | 'end', of: { lease?: string | undefined; after?: number | undefined; digest?: string | undefined } = {}): Promise<Invocation> =>
    this.call('POST', `/v1/invocations/${seg(id)}/release`, { then, ...of }, { restrains: then === 'end' });
}

function seg(id: string): string {
  return encodeURIComponent(id);
}

const BROKEN_OFF: Problem = { ...UNREACHABLE, detail: 'The server broke off within its answer.' };

async function jsonOf<T>(response: Response): Promise<T> {
  try {
    return (await response.json()) as T;
  } catch {
    throw new ApiError(BROKEN_OFF);
  }
}

async function blobOf(response: Response): Promise<Blob> {
  try {
    return await response.blob();
  } catch {
    throw new ApiError(BROKEN_OFF);
  }
}

async function problemOf(response: Response): Promise<Problem> {
  try {
    const said = (await response.json()) as Partial<Problem>;
    if (typeof said.code === 'string' && typeof said.detail === 'string') {
      return { title: '', ...said, status: response.status, code: said.code, detail: said.detail };
    }
  } catch {
    // an answer without a problem document: a proxy's, or one cut short
  }
  return { title: response.statusText, status: response.status, detail: `The server answered ${response.status}.`, code: UNKNOWN };
}
