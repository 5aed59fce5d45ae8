// A tar archive (POSIX pax) of a folder that a browser was given, as a Blob: nothing is copied into memory.

export interface Entry { path: string; file: File }

/** Directories that hold nothing of a package, as `cloudroidctl push` leaves them out. */
const LEFT_OUT = new Set(['.git', '.hg', '.svn', '.catkin_tools', '__pycache__']);
/** Beside `src` of a workspace: what catkin or colcon made of it. */
const MADE_OF_IT = new Set(['build', 'devel', 'install', 'log', 'logs', 'build_isolated']);
const BLOCK = 512;
const utf8 = new TextEncoder();

/** What of a folder's files is sent. */
export function chosen(all: Entry[]): Entry[] {
  const workspace = all.some((one) => one.path.startsWith('src/')) && !all.some((one) => one.path === 'package.xml');
  return all
    .filter(({ path }) => {
      const segments = path.split('/');
      return !segments.some((one) => LEFT_OUT.has(one)) && !(workspace && MADE_OF_IT.has(segments[0] ?? ''));
    })
    .sort((a, b) => (a.path < b.path ? -1 : 1));
}

/** Time of the newest file, in seconds since 1970. */
export const newestSource = (entries: Entry[]) => Math.floor(entries.reduce((newest, { file }) => Math.max(newest, file.lastModified), 0) / 1000);

export const holdsPackage = (entries: Entry[]) => entries.some(({ path }) => path === 'package.xml' || path.endsWith('/package.xml'));

function header(name: Uint8Array, size: number, mode: number, kind: string): Uint8Array {
  const block = new Uint8Array(BLOCK);
  const octal = (value: number, at: number, length: number) => block.set(utf8.encode(value.toString(8).padStart(length - 1, '0')), at);
  block.set(name.subarray(0, 100), 0);
  octal(mode, 100, 8);
  octal(0, 108, 8);
  octal(0, 116, 8);
  octal(size, 124, 12);
  octal(0, 136, 12);
  block.fill(32, 148, 156);
  block.set(utf8.encode(kind), 156);
  block.set(utf8.encode('ustar\x0000'), 257);
  octal(block.reduce((sum, byte) => sum + byte, 0), 148, 7);
  return block;
}

const filled = (size: number) => new Uint8Array((BLOCK - (size % BLOCK)) % BLOCK);

/** A record of pax whose length counts itself: `LENGTH path=NAME\n`. */
function longName(name: Uint8Array): Uint8Array[] {
  const rest = name.length + ' path=\n'.length;
  let length = rest + String(rest).length;
  length = rest + String(length).length;
  const record = new Uint8Array([...utf8.encode(`${length} path=`), ...name, 10]);
  return [header(utf8.encode('pax'), record.length, 0o644, 'x'), record, filled(record.length)];
}

/** Whether a file is a program. Browsers do not say: scripts are told by their first bytes, as the kernel does, and so is ELF. */
async function isProgram(file: File): Promise<boolean> {
  const [one, two, three, four] = new Uint8Array(await file.slice(0, 4).arrayBuffer());
  return (one === 0x23 && two === 0x21) || (one === 0x7f && two === 0x45 && three === 0x4c && four === 0x46);
}

/** The archive of a folder's files. */
export async function tar(entries: Entry[]): Promise<Blob> {
  const parts: BlobPart[] = [];
  for (const { path, file } of entries) {
    const name = utf8.encode(path);
    if (name.length > 100) parts.push(...(longName(name) as BlobPart[]));
    parts.push(header(name, file.size, (await isProgram(file)) ? 0o755 : 0o644, '0') as BlobPart, file, filled(file.size) as BlobPart);
  }
  parts.push(new Uint8Array(2 * BLOCK));
  return new Blob(parts, { type: 'application/x-tar' });
}

/** Files of a folder that was chosen in a dialogue: without the folder's own name. */
export const ofInput = (files: FileList): Entry[] =>
  [...files].map((file) => ({ path: file.webkitRelativePath.split('/').slice(1).join('/'), file }));

/** Files of a folder that was dropped. */
export async function ofDropped(folder: FileSystemDirectoryEntry): Promise<Entry[]> {
  const found: Entry[] = [];
  async function walk(directory: FileSystemDirectoryEntry, prefix: string): Promise<void> {
    const reader = directory.createReader();
    for (;;) {
      // A hundred at a time, in Chromium.
      const some = await new Promise<FileSystemEntry[]>((resolve, reject) => reader.readEntries(resolve, reject));
      if (!some.length) return;
      for (const one of some) {
        const path = `${prefix}${one.name}`;
        if (one.isDirectory) {
          if (!LEFT_OUT.has(one.name)) await walk(one as FileSystemDirectoryEntry, `${path}/`);
        } else {
          const file = await new Promise<File>((resolve, reject) => (one as FileSystemFileEntry).file(resolve, reject));
          found.push({ path, file });
        }
      }
    }
  }
  await walk(folder, '');
  return found;
}
