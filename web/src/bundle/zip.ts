/**
 * Zip archives of a few pieces, stored or deflated, held against what they say of themselves before they are unpacked: the
 * first piece begins the file, the directory ends it, and there are no extra fields and no comment.
 */

import { BundleError, EXPORT_AGAIN } from "./errors.ts";

const END = 0x06054b50, ENTRY = 0x02014b50, LOCAL = 0x04034b50;
const END_SIZE = 22;
/** Flags of encryption and patches; the latest version of the format that readers know. */
const UNKNOWN_FLAGS = 0x61, LATEST_VERSION = 63;
const MOST_PIECES = 64, MOST_BYTES = 512 * 2 ** 20;
/** Deflate makes a thousand of one; what tensors unpack to is a few times their size. */
const FREELY_UNPACKED = 4 * 2 ** 20, MOST_UNPACKING = 100;
const NAME = /^[a-z][a-z0-9_]{0,60}\.[a-z]{1,16}$/;

interface Entry {
  name: string;
  method: number;
  /** CRC-32 of the content. */
  check: number;
  packed: number;
  unpacked: number;
  offset: number;
}

/** Returns the pieces of an archive by name. */
export async function unzip(data: Uint8Array<ArrayBuffer>): Promise<Map<string, Uint8Array<ArrayBuffer>>> {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const entries = directory(view);
  const total = entries.reduce((sum, entry) => sum + entry.unpacked, 0);
  if (total > Math.min(MOST_BYTES, Math.max(FREELY_UNPACKED, MOST_UNPACKING * data.length))) {
    throw damaged(`${data.length} bytes that unpack to ${total}`);
  }
  const pieces = new Map<string, Uint8Array<ArrayBuffer>>();
  for (const entry of entries) {
    if (!NAME.test(entry.name) || pieces.has(entry.name)) throw damaged(`a piece "${entry.name.slice(0, 80)}"`);
    const content = await unpacked(data, view, entry);
    if (crc32(content) !== entry.check) throw damaged(`a damaged piece ${entry.name}`);
    pieces.set(entry.name, content);
  }
  return pieces;
}

function damaged(received: string): BundleError {
  return new BundleError("the file", "an avatar that smplxpp export wrote", received, EXPORT_AGAIN);
}

function directory(view: DataView): Entry[] {
  const end = view.byteLength - END_SIZE;
  if (end < 0 || view.getUint32(end, true) !== END || view.getUint16(end + 20, true)) {
    const zip = view.byteLength >= 4 && view.getUint32(0, true) === LOCAL;
    throw damaged(zip ? `the beginning of one: the file is cut off after ${view.byteLength} bytes` : "another file");
  }
  const count = view.getUint16(end + 10, true);
  let at = view.getUint32(end + 16, true);
  if (count > MOST_PIECES) throw damaged(`${count} pieces`);
  if (at + view.getUint32(end + 12, true) !== end) throw damaged("a zip with other bytes about its pieces");
  const entries: Entry[] = [];
  for (let k = 0; k < count; ++k) {
    if (at + 46 > end || view.getUint32(at, true) !== ENTRY) throw damaged("a damaged directory");
    const [name, extra, comment] = [28, 30, 32].map((offset) => view.getUint16(at + offset, true));
    if (at + 46 + name + comment > end || extra) throw damaged("a damaged directory");
    if (view.getUint16(at + 6, true) > LATEST_VERSION || view.getUint16(at + 8, true) & UNKNOWN_FLAGS) throw damaged("a piece in another way");
    entries.push({
      name: new TextDecoder().decode(new Uint8Array(view.buffer, view.byteOffset + at + 46, name)),
      method: view.getUint16(at + 10, true),
      check: view.getUint32(at + 16, true),
      packed: view.getUint32(at + 20, true),
      unpacked: view.getUint32(at + 24, true),
      offset: view.getUint32(at + 42, true),
    });
    at += 46 + name + comment;
  }
  if (at !== end || Math.min(...entries.map(({ offset }) => offset), Infinity) > 0) throw damaged("a zip with other bytes about its pieces");
  return entries;
}

async function unpacked(data: Uint8Array<ArrayBuffer>, view: DataView, entry: Entry): Promise<Uint8Array<ArrayBuffer>> {
  const { name, offset, packed, method } = entry;
  if (offset + 30 > data.length || view.getUint32(offset, true) !== LOCAL) throw damaged(`no piece ${name} in its place`);
  const named = view.getUint16(offset + 26, true), start = offset + 30 + named + view.getUint16(offset + 28, true);
  if (new TextDecoder().decode(data.subarray(offset + 30, offset + 30 + named)) !== name) throw damaged(`another piece than ${name}`);
  if (start + packed > data.length) throw damaged(`a piece ${name} that is cut off`);
  const content = data.slice(start, start + packed);
  if (method === 0 && packed === entry.unpacked) return content;
  if (method !== 8) throw damaged(`a piece ${name} packed in another way`);
  const out = new Uint8Array(entry.unpacked);
  let filled = 0;
  try {
    const reader = new Blob([content]).stream().pipeThrough(new DecompressionStream("deflate-raw")).getReader();
    for (let step = await reader.read(); !step.done; step = await reader.read()) {
      if (filled + step.value.length > out.length) {
        await reader.cancel();
        throw damaged(`a piece ${name} longer than it says`);
      }
      out.set(step.value, filled);
      filled += step.value.length;
    }
  } catch (error) {
    throw error instanceof BundleError ? error : damaged(`a damaged piece ${name}`);
  }
  if (filled !== out.length) throw damaged(`a piece ${name} shorter than it says`);
  return out;
}

const TABLE = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let k = 0; k < 8; ++k) n = n & 1 ? 0xedb88320 ^ (n >>> 1) : n >>> 1;
  return n;
});

function crc32(data: Uint8Array): number {
  let crc = 0xffffffff;
  for (let i = 0; i < data.length; ++i) crc = TABLE[(crc ^ data[i]) & 255] ^ (crc >>> 8);
  return ~crc >>> 0;
}
