/** The Worker that keeps the console's socket: its timers run on while the page is hidden. */
import { Connection, type Health } from './connection';
import type { Down, Up } from './messages';

export type ToWorker = { do: 'open'; url: string; token: string } | { do: 'send'; message: Up } | { do: 'end' };
export type FromWorker =
  | { is: 'message'; message: Down }
  | { is: 'frame'; buffer: ArrayBuffer }
  | { is: 'health'; health: Health }
  | { is: 'refused'; why: string };

const scope = self as unknown as {
  postMessage(message: FromWorker, transfer?: Transferable[]): void;
  onmessage: ((event: MessageEvent<ToWorker>) => void) | null;
};
let connection: Connection | null = null;

scope.onmessage = ({ data }) => {
  switch (data.do) {
    case 'open':
      connection?.end();
      connection = new Connection(data.url, data.token, {
        message: (message) => scope.postMessage({ is: 'message', message }),
        frame: (buffer) => scope.postMessage({ is: 'frame', buffer }, [buffer]),
        health: (health) => scope.postMessage({ is: 'health', health }),
        refused: (why) => scope.postMessage({ is: 'refused', why }),
      });
      break;
    case 'send':
      connection?.send(data.message);
      break;
    case 'end':
      connection?.end();
      connection = null;
  }
};
