/** Half-precision floats (IEEE 754 binary16), which no browser of today reads as an array everywhere. */

let table: Float32Array | undefined;

function values(): Float32Array {
  if (table) return table;
  table = new Float32Array(65536);
  for (let bits = 0; bits < 65536; ++bits) {
    const sign = bits & 0x8000 ? -1 : 1;
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    table[bits] =
      exponent === 31
        ? fraction ? NaN : sign * Infinity
        : sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : (2 ** -14 * fraction) / 1024);
  }
  return table;
}

/** The numbers whose 16 bits are given. */
export function floatsFromHalves(halves: Uint16Array): Float32Array {
  const of = values();
  const out = new Float32Array(halves.length);
  for (let i = 0; i < halves.length; ++i) out[i] = of[halves[i]];
  return out;
}
