/** Makes a candidate of what a person picked: a folder, files, or an archive of them. */
import { MAX_BYTES, PickUnreadable, unzip } from './zip';

export type Files = Record<string, string>;

export interface Candidate {
  files: Files;
  /** What was picked and is no part of a candidate. */
  leftOut: string[];
  /** Whether everything else was taken from what is in force. */
  partial: boolean;
}

export interface Picked {
  path: string;
  text: string;
}

/** What makes a policy directory one; with fewer, the pick is taken for changes to what is in force. */
const WHOLE = ['site.yaml', 'organization.yaml', 'authority.yaml'];
const FOLDERS = ['capabilities', 'profiles', 'tests'];
/** What the server takes of one at most. To show more would hold the whole page up, and the stop in it. */
const MAX_TEXT = 4 * 1024 * 1024;
const TOO_LARGE = 'what was picked is larger than any policy';

/** What is brought of a version that is there: its files, and what it promises beside them. */
export function filesOf({ files, promises }: { files: Files; promises: string | null }): Files {
  return promises === null ? files : { ...files, 'properties.yaml': promises };
}

/** Reads what an input of files holds; an archive among them stands for its entries. */
export async function read(picked: Iterable<File>): Promise<Picked[]> {
  const found: Picked[] = [];
  let length = 0;
  for (const file of picked) {
    const inside = await contentOf(file, file.webkitRelativePath || file.name);
    found.push(...inside);
    length += inside.reduce((sum, { text }) => sum + text.length, 0);
    if (length > MAX_TEXT) throw new PickUnreadable(TOO_LARGE);
  }
  return found;
}

async function contentOf(file: File, path: string): Promise<Picked[]> {
  const packed = /\.zip$/i.test(path);
  if (!packed && !isText(path)) return [{ path, text: '' }];
  if (file.size > (packed ? MAX_BYTES : MAX_TEXT)) throw new PickUnreadable(TOO_LARGE);
  const bytes = await file.arrayBuffer();
  if (!packed) return [{ path, text: decoded(path, new Uint8Array(bytes)) }];
  return (await unzip(bytes)).map((entry) => ({ path: entry.path, text: decoded(entry.path, entry.bytes) }));
}

function isText(path: string): boolean {
  return /\.(ya?ml|json)$/i.test(path);
}

function decoded(path: string, bytes: Uint8Array): string {
  if (!isText(path)) return '';
  try {
    return new TextDecoder('utf-8', { fatal: true }).decode(bytes);
  } catch {
    throw new PickUnreadable(`\`${path}\` is no UTF-8 text`);
  }
}

/** Puts what was picked at its place in a policy directory; `live` is what is in force. */
export function candidateOf(picked: Picked[], live: Files): Candidate {
  const clean = picked.map(({ path, text }) => ({ path: path.replaceAll('\\', '/').replace(/^(\.?\/)+/, ''), text }));
  const root = rootOf(clean.map(({ path }) => path));
  const files: Files = {};
  const from: Record<string, string> = {};
  const leftOut: string[] = [];
  for (const { path, text } of clean) {
    const inside = path.startsWith(root) ? path.slice(root.length) : path;
    const hidden = inside.split('/').some((part) => part.startsWith('.') || part === '__MACOSX');
    if (hidden || !isText(inside)) {
      leftOut.push(inside);
      continue;
    }
    const place = placed(inside, text, live);
    // Which of the two is meant, only the one who picked them knows.
    if (place in files) throw new PickUnreadable(`\`${from[place]}\` and \`${path}\` would both be \`${place}\`: pick one of them`);
    files[place] = text;
    from[place] = path;
  }
  const partial = !WHOLE.every((name) => name in files);
  return { files: partial ? { ...live, ...files } : files, leftOut, partial };
}

/** The folder that holds the policy: where `site.yaml` stands, or one that everything is in. */
function rootOf(paths: string[]): string {
  const known = paths.filter((path) => WHOLE.includes(path.split('/').at(-1) ?? '')).sort((a, b) => a.length - b.length)[0];
  if (known !== undefined) return known.slice(0, known.lastIndexOf('/') + 1);
  const [first] = paths[0]?.split('/') ?? [];
  const shared = first !== undefined && !FOLDERS.includes(first) && paths.every((path) => path.startsWith(`${first}/`));
  return shared ? `${first}/` : '';
}

/** Where a single file belongs: where one of that name is, or where its first key says. */
function placed(path: string, text: string, live: Files): string {
  if (path.includes('/') || path in live) return path;
  const same = Object.keys(live).find((known) => known.endsWith(`/${path}`));
  if (same !== undefined) return same;
  const key = /^([a-z_]+):/m.exec(text)?.[1];
  const folder = { profile: 'profiles', name: 'capabilities', cases: 'tests' }[key ?? ''];
  return folder === undefined ? path : `${folder}/${path}`;
}

export type Standing = 'new' | 'changed' | 'gone' | 'same';

/** How each file of a candidate stands to what is in force, files that changed first. */
export function standings(files: Files, live: Files): { path: string; standing: Standing }[] {
  const names = [...new Set([...Object.keys(files), ...Object.keys(live)])].sort();
  const found = names.map((path) => ({ path, standing: standingOf(files[path], live[path], path) }));
  const order: Standing[] = ['new', 'changed', 'gone', 'same'];
  return found.sort((a, b) => order.indexOf(a.standing) - order.indexOf(b.standing));
}

function standingOf(now: string | undefined, was: string | undefined, path: string): Standing {
  if (now === undefined) return 'gone';
  if (was === undefined) return path.startsWith('tests/') ? 'same' : 'new'; // cases are never part of what is in force
  return now === was ? 'same' : 'changed';
}

export interface Fault {
  file: string;
  /** From 1; 0 where the fault is about a file as a whole. */
  line: number;
  field: string;
  message: string;
}

/** Faults in order of file and line. */
export function inOrder(faults: Fault[]): Fault[] {
  return [...faults].sort((a, b) => a.file.localeCompare(b.file) || a.line - b.line);
}

/** Where a line begins and ends in a text, for a selection; the nearest one there is. */
export function lineSpan(text: string, line: number): [number, number] {
  const lines = text.split('\n');
  const index = Math.min(Math.max(line, 1), lines.length) - 1;
  const start = lines.slice(0, index).reduce((sum, one) => sum + one.length + 1, 0);
  return [start, start + (lines[index]?.length ?? 0)];
}
