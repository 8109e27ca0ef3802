/** Radiance pictures (.hdr), as `smplxpp.core.files.panorama_file` reads them. */

import type { Panorama } from "./irradiance.ts";

const MAGIC = ["#?RADIANCE", "#?RGBE"], FORMAT = "32-bit_rle_rgbe";
const MOST_PIXELS = 1 << 26, LONGEST_HEADER = 1 << 16, RUN = 128;

/** Whether a file says that it is one. */
export function isRadiance(data: Uint8Array): boolean {
  return MAGIC.some((magic) => text(data, 0, magic.length) === magic);
}

/** Reads a picture, linear light. @throws Error another kind of file, or a damaged one. */
export function readRadiance(data: Uint8Array): Panorama {
  const [width, height, begin] = header(data);
  if (data.length - begin < 4 * height) throw new Error("this picture is cut off");
  const pixels = new Float32Array(3 * width * height), row = new Uint8Array(4 * width);
  let at = begin;
  for (let y = 0; y < height; ++y) {
    at = readRow(data, at, row);
    for (let x = 0; x < width; ++x) {
      // Mantissas of all three colours, one exponent.
      const exponent = row[4 * x + 3], scale = exponent ? 2 ** (exponent - 136) : 0;
      for (let k = 0; k < 3; ++k) pixels[3 * (y * width + x) + k] = row[4 * x + k] * scale;
    }
  }
  return { width, height, pixels };
}

/** Width, height, and where the pixels begin. */
function header(data: Uint8Array): [number, number, number] {
  const whole = text(data, 0, Math.min(data.length, LONGEST_HEADER)), end = whole.indexOf("\n\n");
  if (!isRadiance(data) || end < 0) throw new Error("this is no Radiance picture (.hdr)");
  const format = whole.slice(0, end).split("\n").find((line) => line.startsWith("FORMAT="));
  if (format && format.slice(7).trim() !== FORMAT) throw new Error("only Radiance pictures in RGBE are read");
  const stop = whole.indexOf("\n", end + 2);
  const size = /^-Y (\d{1,6}) \+X (\d{1,6})$/.exec(whole.slice(end + 2, Math.max(stop, 0)).trim());
  if (!size) throw new Error("only pictures with rows from the top are read");
  const height = Number(size[1]), width = Number(size[2]);
  if (!(width * height > 0 && width * height <= MOST_PIXELS)) throw new Error("this picture is too large");
  return [width, height, stop + 1];
}

/** Decodes one row of (W, 4) bytes; returns where the next one begins. */
function readRow(data: Uint8Array, at: number, row: Uint8Array): number {
  const width = row.length / 4;
  if (!(width >= 8 && width < 32768 && data[at] === 2 && data[at + 1] === 2)) {
    const old = data[at] === 1 && data[at + 1] === 1 && data[at + 2] === 1;
    if (old || at + row.length > data.length) throw damaged();
    row.set(data.subarray(at, at + row.length));
    return at + row.length;
  }
  if (((data[at + 2] << 8) | data[at + 3]) !== width) throw damaged();
  at += 4;
  for (let channel = 0; channel < 4; ++channel) {
    for (let x = 0; x < width; ) {
      const same = data[at] > RUN, count = same ? data[at] - RUN : data[at], bytes = same ? 1 : count;
      if (!(count > 0 && count <= width - x && at + bytes < data.length)) throw damaged();
      for (let k = 0; k < count; ++k) row[4 * (x + k) + channel] = data[at + 1 + (same ? 0 : k)];
      x += count;
      at += 1 + bytes;
    }
  }
  return at;
}

function damaged(): Error {
  return new Error("this picture is damaged");
}

function text(data: Uint8Array, from: number, to: number): string {
  let out = "";
  for (let i = from; i < Math.min(to, data.length); ++i) out += String.fromCharCode(data[i]);
  return out;
}
