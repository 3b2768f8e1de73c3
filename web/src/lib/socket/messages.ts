import type { Cell, Escalation, Grant, Invocation, LogEvent, Review } from '../api/documents';

/** The console socket's frames (docs/design/console.md). */
export const SUBPROTOCOL = 'reins.console.1';

export interface Changes {
  seq: number;
  events?: LogEvent[];
  invocations?: Invocation[];
  escalations?: Escalation[];
  cells?: Cell[];
  /** Names of cells that the server knows no more; of an update alone. */
  cells_gone?: string[];
  grants?: Grant[];
  reviews?: Review[];
  /** How many wait, those included that are not told of. */
  reviews_waiting?: number;
}

export interface Shape {
  body: string;
  shape: 'plane' | 'sphere' | 'capsule' | 'cylinder' | 'box';
  size: number[];
  pose: number[];
  rgba: number[];
}

export interface ZoneShape {
  name: string;
  kind: 'forbidden' | 'restricted' | 'shared';
  polygon: [number, number][];
}

export interface Scene {
  bounds_m: [number, number, number, number];
  zones: ZoneShape[];
  shapes: Shape[];
  fixed: Record<string, number[]>;
}

export type Down =
  | { type: 'welcome'; version: number; name: string; role: string; station: string | null; boot: string; at: string | number }
  | ({ type: 'snapshot' } & Required<Omit<Changes, 'cells_gone'>>)
  | ({ type: 'update'; beat?: number } & Changes)
  | { type: 'scene'; cell: string; scene: Scene; bodies: string[]; gauges: string[] }
  | { type: 'path'; cell: string; invocation: string | null; points: [number, number][] }
  | { type: 'beat'; n: number; at: string | number; seq: number }
  | { type: 'pong'; at_ms: number }
  | { type: 'jogged'; cell: string; n: number; refused: string | null };

export interface Jog {
  type: 'jog';
  cell: string;
  lease: string;
  n: number;
  base: [number, number, number];
  tool: [number, number, number];
  grip: 'open' | 'close' | null;
}

/** Of when something said is: the newest beat that had come, 0 where none had, and how long before. */
export interface Age {
  beat: number;
  since_ms: number;
}

export type Up =
  | { type: 'hello'; token: string; after: number | null }
  | { type: 'watch'; cells: string[] }
  | { type: 'ack'; cell: number; frame: number }
  | { type: 'ack'; beat: number }
  | { type: 'ping'; at_ms: number }
  | { type: 'estop'; cell: string }
  | (Jog & Age);

export const CLOSED: Record<number, string> = {
  4400: 'This console said something the server did not understand.',
  4401: 'This token is not valid here, or not any more.',
  4403: 'This role or address may not use the console.',
  4408: 'The server waited too long for this console.',
  4410: 'This console fell behind.',
  4429: 'As many consoles are open as the server may have.',
};

/** The longest token that a `hello` may bring; a longer one is no message to the server, which says nothing of tokens then. */
export const LONGEST_TOKEN = 512;

/** Close codes after which coming back with the same token is pointless. */
export const FINAL_CODES: ReadonlySet<number> = new Set([4401, 4403]);
