/** What the server answers with, as its HTTP contract names it. Quantities are SI and carry their unit in their name. */

export type Json = null | boolean | number | string | Json[] | { [key: string]: Json };
export type Params = Record<string, Json>;

export type Risk = 'low' | 'medium' | 'high' | 'critical';
export type Status =
  | 'rejected'
  | 'deferred'
  | 'denied'
  | 'awaiting_approval'
  | 'running'
  | 'paused'
  | 'escalated'
  | 'recovering'
  | 'taken_over'
  | 'completed'
  | 'failed';

export interface Reason {
  rule: string;
  code: string;
  message: string;
  remedy: string;
}

export interface Change {
  param: string;
  requested: Json;
  effective: Json;
  rule: string;
}

export interface Invocation {
  id: string;
  status: Status;
  capability: string;
  agent: string;
  cell: string | null;
  profile: string;
  policy_version: string;
  requested: Params;
  effective: Params | null;
  admission: { outcome: string; reasons: Reason[]; retry_after_s?: number | null };
  policy: { outcome: string; reasons: Reason[]; changes: Change[] } | null;
  escalation: { id: string; status: string; expires_at: string | null } | null;
  outcome: string | null;
  failure?: { reasons: Reason[] } | null;
  created_at: string;
  updated_at: string;
}

/** What authority asks for before launch: so many different people's approval, within so many seconds, and why. */
export interface Asking {
  reasons: Reason[];
  needed: number;
  within_s: number;
}

/** What would become of a proposal now; `asks` stands where people would be asked. */
export type Verdict = Omit<Invocation, 'id' | 'status' | 'created_at' | 'updated_at'> & {
  status: 'allowed' | 'rejected' | 'deferred' | 'denied' | 'awaiting_approval';
  asks?: Asking | null;
};

export interface Approval {
  by: string;
  at: string;
  digest: string;
}

export interface Escalation {
  id: string;
  invocation: string;
  kind: string;
  capability: string;
  agent: string;
  risk: Risk;
  reasons: Reason[];
  requested: Params;
  /** What policy made of it; `effective` is what is asked about now, perhaps edited by an approver. */
  constrained?: Params;
  effective: Params;
  phase?: string | null;
  cell?: string | null;
  digest: string;
  status: 'pending' | 'approved' | 'denied' | 'expired' | 'withdrawn';
  approvals: Approval[];
  /** Oldest first; `params` is what was asked from then on. */
  edits?: { by: string; at: string; params: Params; digest: string }[];
  needed: number;
  expires_at: string | null;
  created_at?: string;
  acknowledged?: { by: string; since: string }[];
  /** Whether a grant may be for the proposal's task: one without a name has none. */
  names_task?: boolean;
  /** What the gripper held when it was asked, where that is what is handled. */
  carried?: string | null;
  /** What the agent says it is after, and what it calls its task: words of its own, which nobody has checked. */
  goal?: string | null;
  task?: string | null;
  on_deny?: 'deny' | 'terminate' | 'rollback';
  on_timeout?: 'deny' | 'terminate' | 'rollback';
  /** Why it was asked anew, under another digest; null where it was not. */
  renewed?: 'policy_changed' | 'profile_changed' | null;
}

export interface LogEvent {
  seq: number;
  at: string;
  kind: string;
  invocation: string | null;
  actor: string;
  body: Record<string, Json>;
}

/** Events by `seq`; a search says how many it looked at, and the last of them. */
export interface EventList extends List<LogEvent> {
  searched?: { events: number; seq: number | null; at: string | null };
}

/** Who drives a cell by hand. */
export interface Control {
  lease: string;
  holder: string;
  where: 'local' | 'remote';
  since: string;
  invocation: string | null;
  phase?: 'held' | 'returning';
  /** Why the newest command is not obeyed. */
  refused?: string | null;
}

export interface WorldFacts {
  holding?: string | null;
  base?: [number, number, number];
  objects?: Record<string, { visible: boolean; reachable: boolean; x_m: number; y_m: number; z_m: number }>;
  people_count?: number;
  people_nearest_m?: number;
}

export interface Cell {
  id: string;
  online: boolean;
  latched: boolean;
  profile: string;
  busy: string | null;
  status: string | null;
  holding_link: boolean;
  /** Why it moves nothing, stop or not: it can record nothing, or what guards it broke. */
  fault?: string | null;
  robot: string | null;
  policy_version: string | null;
  facts: WorldFacts | null;
  gauges: Record<string, number>;
  session?: { profile?: string; phase: string | null; doing: string; violated: string[]; paused_by: string[]; waits_for: string | null } | null;
  control?: Control | null;
  /** Stands in the answer to the first step of a reset. */
  arming?: { code: string; expires_at: string } | null;
  /** Who may take the second step of a reset now. */
  armed_by?: string | null;
  recorded?: boolean | null;
}

export interface Grant {
  id: string;
  status: 'active' | 'ended';
  capability: string;
  agent: string;
  cell: string;
  profile: string;
  scope: 'object' | 'task' | 'time';
  object: string | null;
  task: string | null;
  issued_by: string;
  expires_at: string;
  uses: number;
  ended?: { code: string; by: string; at: string } | null;
}

export type ReviewVerdict = 'accepted' | 'objected' | 'inconclusive';

export interface Review {
  id: string;
  invocation: string;
  status: 'waiting' | ReviewVerdict;
  capability: string;
  agent: string;
  cell: string | null;
  profile: string;
  risk: Risk;
  outcome: string;
  reasons: Reason[];
  verdict: { by: string; at: string; verdict: ReviewVerdict; note: string | null } | null;
  created_at: string;
}

/** A capability package; `inputs` is a JSON Schema whose numbers carry `unit`. */
export interface Capability {
  name: string;
  version: string;
  summary: string;
  inputs: { properties?: Record<string, InputSchema>; required?: string[] };
  risk: Risk;
  /** `allowed`, `guarded`, `approval-required` or `forbidden`, by profile. */
  env_profile?: Record<string, string>;
  recovery?: boolean;
}

export interface InputSchema {
  type?: string;
  unit?: string;
  minimum?: number;
  maximum?: number;
  default?: Json;
  enum?: Json[];
  'x-limit'?: string;
  'x-ref'?: string;
}

/** Phases of a capability before which its session waits, holding, until a person lets it go on. */
export interface Confirming {
  capability: string;
  profile: string;
  phases: string[];
  within_s: number;
  on_deny: string;
  on_timeout: string;
}

export interface PolicySet {
  version: string;
  capabilities: string[];
  profiles: Record<string, { limits?: Record<string, { max?: number; min?: number }>; [key: string]: unknown }>;
  rules: Record<string, unknown>[];
  agents: Record<string, unknown>;
  authority?: { denials?: unknown; grants?: { up_to_s: number; risk: string[] } | null; confirm_before?: Confirming[]; [key: string]: unknown };
  site: Record<string, unknown>;
}

/** A watch rule as `/v1/policies/active/watch` describes it. */
export interface WatchRule {
  id: string;
  applies_to: string[] | null;
  signal: string;
  above: boolean;
  /** A number in the signal's unit, the name of what is computed, or a limit times a factor. */
  threshold: number | string | { limit: string; times: number };
  for_ms: number;
  response: { enter: string; clear_after_ms: number; clear_beyond: number; then: string; persist_ms: number | null; else: string };
}

/** What each profile watches. */
export interface Watched {
  version: string;
  profiles: Record<string, { watch: WatchRule[]; stale_after_ms: Record<string, number>; separation: Record<string, number> | null }>;
}

export interface List<T> {
  items: T[];
  next: string | number | null;
}

/** RFC 9457 with a stable `code`. */
export interface Problem {
  title: string;
  status: number;
  detail: string;
  code: string;
  /** Of a policy each has its file and line. */
  errors?: { field: string; message: string; file?: string; line?: number }[];
  reasons?: Reason[];
  /** Said with the next hand-back, it approves what the reasons ask people about. */
  digest?: string;
}

/** Telemetry of a finished session as columns by channel; times are the channel `time_s`. */
export interface Telemetry {
  invocation: string;
  part: number;
  parts: number;
  file: string;
  sha256: string;
  intact: boolean;
  start_at: string;
  rows: number;
  every: number;
  units: Record<string, string>;
  columns: Record<string, (number | null)[]>;
  /** Whom the tracker saw at each time: number, x and y in m, world frame. No times: none was recorded. */
  people: { time_s: number[]; tracks: [number, number, number][][] };
  /** Poses (x, y, z, qw, qx, qy, qz, world frame) of things, each from its time until the next. */
  bodies: Record<string, { time_s: number[]; pose: number[][] }>;
}

export interface Checkpoint {
  size: number;
  root: string;
  checkpoint: string;
  key: string;
}

export interface Verification {
  ok: boolean;
  size: number;
  root: string;
  checkpoint: string | null;
  first_bad: number | null;
  problem: string | null;
}

export type Direction = 'same' | 'tightens' | 'loosens' | 'both';

/** A version of policy: whose it is, and what became of it. */
export interface Version {
  digest: string;
  status: 'candidate' | 'awaiting_second' | 'active' | 'former';
  source: 'request' | 'directory';
  by: string;
  why: string;
  against: string | null;
  rules: number;
  cases: number;
  /** What was proved of it; empty as long as nothing was. */
  proved: string;
  verdict: 'proved' | 'refuted' | 'undecided' | 'unknown';
  awaiting: { by: string; at: string; why: string; against: string } | null;
  activations: { at: string; by: string[]; why: string; former: string | null; direction: Direction | null }[];
  created_at: string;
  updated_at: string;
}

export interface VersionList extends List<Version> {
  active: string;
  why: string;
}

/** What a version would change of what is in force; `decisions` where it was proved what follows. */
export interface Comparison {
  direction: Direction;
  proved?: boolean;
  differences: { part: string; before: string; after: string; direction: Direction }[];
  decisions?: Transition[];
}

export interface Transition {
  capability: string;
  profile: string;
  change: string;
  direction: Direction;
  decided: boolean;
  message: string;
  /** A case file. */
  example: string;
  /** What becomes of the example by what is in force, and by the candidate. */
  before: Decided | null;
  after: Decided | null;
}

export interface Decided {
  what: 'allow' | 'approve' | 'deny';
  approvers: number;
  values: Params;
  rules: string[];
}

/** What a candidate would have decided otherwise on live traffic. */
export interface Shadow {
  digest: string;
  on: boolean;
  by: string | null;
  why: string | null;
  since: string | null;
  decisions: number;
  differing: number;
  groups: { capability: string; profile: string; live: string; candidate: string; count: number; examples: string[] }[];
}
