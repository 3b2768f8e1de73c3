/** The Worker that keeps the console's socket: its timers run on while the page is hidden. */
import { Connection, type Health } from './connection';
import type { Down, Up } from './messages';
import { Outbox } from './outbox';

/** `took`: the page has taken what it was told last. */
export type ToWorker = { do: 'open'; url: string; token: string } | { do: 'send'; message: Up } | { do: 'took' } | { do: 'end' };
export type FromWorker =
  /** `atMs`: when it came, or was so, by the Worker's own clock. */
  | { is: 'message'; message: Down; atMs: number }
  | { is: 'frame'; buffer: ArrayBuffer }
  | { is: 'health'; health: Health; atMs: number }
  | { is: 'refused'; why: string };

const scope = self as unknown as {
  postMessage(all: readonly FromWorker[], transfer: Transferable[]): void;
  onmessage: ((event: MessageEvent<ToWorker>) => void) | null;
};
let connection: Connection | null = null;
const page = new Outbox<FromWorker>((all) => scope.postMessage(all, all.flatMap((one) => (one.is === 'frame' ? [one.buffer] : []))), 'health');

scope.onmessage = ({ data }) => {
  switch (data.do) {
    case 'open':
      connection?.end();
      connection = new Connection(data.url, data.token, {
        message: (message) => page.put({ is: 'message', message, atMs: performance.now() }),
        frame: (buffer) => page.put({ is: 'frame', buffer }),
        health: (health) => page.put({ is: 'health', health, atMs: performance.now() }),
        refused: (why) => page.put({ is: 'refused', why }),
      });
      break;
    case 'send':
      connection?.send(data.message);
      break;
    case 'took':
      page.took();
      break;
    case 'end':
      connection?.end();
      connection = null;
  }
};
