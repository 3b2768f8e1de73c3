/**
 * Reads the files of a ZIP archive, as far as archives of text go: stored or deflated entries, no encryption, no ZIP64.
 *
 * The central directory at the end says where everything is (APPNOTE 6.3, 4.3.12); the browser itself inflates.
 */
export interface Entry {
  path: string;
  bytes: Uint8Array<ArrayBuffer>;
}

/** What a person picked cannot be brought; the message says what of it, and why. */
export class PickUnreadable extends Error {}

const END = 0x06054b50;
const DIRECTORY = 0x02014b50;
const LOCAL = 0x04034b50;
const END_SIZE = 22;
const MAX_ENTRIES = 4_000;
export const MAX_BYTES = 16 * 1024 * 1024;

export async function unzip(archive: ArrayBuffer): Promise<Entry[]> {
  const view = new DataView(archive);
  const end = endOf(view);
  const count = view.getUint16(end + 10, true);
  if (count > MAX_ENTRIES) throw new PickUnreadable(`the archive has ${count} entries; at most ${MAX_ENTRIES} are read`);
  const entries: Entry[] = [];
  let at = view.getUint32(end + 16, true);
  let total = 0;
  for (let k = 0; k < count; k += 1) {
    if (at + 46 > archive.byteLength || view.getUint32(at, true) !== DIRECTORY) throw new PickUnreadable('the archive is damaged');
    const [nameLength, extra, comment] = [28, 30, 32].map((field) => view.getUint16(at + field, true)) as [number, number, number];
    const path = new TextDecoder().decode(new Uint8Array(archive, at + 46, nameLength));
    total += view.getUint32(at + 24, true);
    if (total > MAX_BYTES) throw new PickUnreadable('the archive is larger than any policy');
    if (!path.endsWith('/')) entries.push({ path, bytes: await content(archive, view, at, path) });
    at += 46 + nameLength + extra + comment;
  }
  return entries;
}

function endOf(view: DataView): number {
  for (let at = view.byteLength - END_SIZE; at >= Math.max(0, view.byteLength - END_SIZE - 0xffff); at -= 1) {
    if (view.getUint32(at, true) === END) return at;
  }
  throw new PickUnreadable('this is no ZIP archive');
}

async function content(archive: ArrayBuffer, view: DataView, at: number, path: string): Promise<Uint8Array<ArrayBuffer>> {
  const method = view.getUint16(at + 10, true);
  const encrypted = (view.getUint16(at + 8, true) & 1) === 1;
  const [packed, size, local] = [20, 24, 42].map((field) => view.getUint32(at + field, true)) as [number, number, number];
  if (encrypted || (method !== 0 && method !== 8)) throw new PickUnreadable(`\`${path}\` is packed in a way that is not read here`);
  if (local + 30 > archive.byteLength || view.getUint32(local, true) !== LOCAL) throw new PickUnreadable('the archive is damaged');
  const start = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
  if (start + packed > archive.byteLength) throw new PickUnreadable('the archive is cut short');
  const raw = new Uint8Array(archive, start, packed);
  const bytes = method === 0 ? raw.slice() : await inflate(raw, size, path);
  if (bytes.length !== size) throw new PickUnreadable(`\`${path}\` is damaged`);
  return bytes;
}

async function inflate(raw: Uint8Array<ArrayBuffer>, size: number, path: string): Promise<Uint8Array<ArrayBuffer>> {
  const out = new Uint8Array(size);
  let filled = 0;
  try {
    const reader = new Blob([raw]).stream().pipeThrough(new DecompressionStream('deflate-raw')).getReader();
    for (let step = await reader.read(); !step.done; step = await reader.read()) {
      if (filled + step.value.length > size) throw new PickUnreadable(`\`${path}\` is larger than it says`);
      out.set(step.value, filled);
      filled += step.value.length;
    }
  } catch (error) {
    throw error instanceof PickUnreadable ? error : new PickUnreadable(`\`${path}\` is damaged`);
  }
  return out.subarray(0, filled);
}
