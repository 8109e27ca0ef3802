/** SHA-256 (FIPS 180-4): by the browser where it offers it (not on every page opened from disk), else by this. */

const K = new Uint32Array(64);
const START = new Uint32Array(8);
{
  // The first 32 bits of the fractional parts of cube and square roots of the first primes.
  const isPrime = (n: number) => Array.from({ length: n }, (_, d) => d).every((d) => d < 2 || n % d !== 0);
  for (let n = 2, found = 0; found < 64; ++n) {
    if (!isPrime(n)) continue;
    K[found] = fraction(n, 3);
    if (found < 8) START[found] = fraction(n, 2);
    ++found;
  }
}

/** floor(2^32 frac(n^(1/root))), exact: the root of n 2^(32 root) as a whole number, by bisection. */
function fraction(n: number, root: number): number {
  const value = BigInt(n) << BigInt(32 * root);
  let low = 0n, high = 1n << 40n;
  while (high - low > 1n) {
    const middle = (low + high) >> 1n;
    if (middle ** BigInt(root) <= value) low = middle;
    else high = middle;
  }
  return Number(low & 0xffffffffn);
}

/** The digest in lower-case hexadecimal digits. */
export async function sha256(data: Uint8Array<ArrayBuffer>): Promise<string> {
  if (globalThis.crypto?.subtle) return hex(new Uint8Array(await crypto.subtle.digest("SHA-256", data)));
  return sha256Here(data);
}

/** The same without the browser's help. */
export function sha256Here(data: Uint8Array<ArrayBuffer>): string {
  const blocks = Math.ceil((data.length + 9) / 64);
  // The data's own blocks are read in place; what is left over and the padding get blocks of their own.
  const whole = Math.floor(data.length / 64), tail = new Uint8Array(64 * (blocks - whole));
  tail.set(data.subarray(64 * whole));
  tail[data.length - 64 * whole] = 0x80;
  const bits = new DataView(tail.buffer);
  bits.setUint32(tail.length - 8, Math.floor(data.length / 2 ** 29));
  bits.setUint32(tail.length - 4, (data.length << 3) >>> 0);
  const state = Uint32Array.from(START), w = new Uint32Array(64);
  const own = new DataView(data.buffer, data.byteOffset, data.byteLength);
  for (let block = 0; block < blocks; ++block) {
    if (block < whole) compress(state, w, own, 64 * block);
    else compress(state, w, bits, 64 * (block - whole));
  }
  const out = new DataView(new ArrayBuffer(32));
  state.forEach((word, i) => out.setUint32(4 * i, word));
  return hex(new Uint8Array(out.buffer));
}

function compress(state: Uint32Array, w: Uint32Array, view: DataView, at: number): void {
  for (let t = 0; t < 16; ++t) w[t] = view.getUint32(at + 4 * t);
  for (let t = 16; t < 64; ++t) {
    const a = w[t - 15], b = w[t - 2];
    const s0 = turn(a, 7) ^ turn(a, 18) ^ (a >>> 3), s1 = turn(b, 17) ^ turn(b, 19) ^ (b >>> 10);
    w[t] = (w[t - 16] + s0 + w[t - 7] + s1) | 0;
  }
  let [a, b, c, d, e, f, g, h] = state;
  for (let t = 0; t < 64; ++t) {
    const s1 = turn(e, 6) ^ turn(e, 11) ^ turn(e, 25);
    const first = (h + s1 + ((e & f) ^ (~e & g)) + K[t] + w[t]) | 0;
    const s0 = turn(a, 2) ^ turn(a, 13) ^ turn(a, 22);
    const second = (s0 + ((a & b) ^ (a & c) ^ (b & c))) | 0;
    h = g, g = f, f = e, e = (d + first) | 0, d = c, c = b, b = a, a = (first + second) | 0;
  }
  [a, b, c, d, e, f, g, h].forEach((value, i) => (state[i] += value));
}

function turn(x: number, by: number): number {
  return (x >>> by) | (x << (32 - by));
}

function hex(bytes: Uint8Array): string {
  return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
