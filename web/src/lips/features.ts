/** Sound to what the lips' network hears of it: `avatar.speech.audio_features`, as the samples come. */

export const RATE = 16000;
/** Samples from a row to the next, and that one row sees. */
export const HOP = 160, WINDOW = 400;
export const BANDS = 32;
const SIZE = 512, LOWEST = 60, HIGHEST = 7600;
const FLOOR = 1e-10, QUIETEST = -50, FORGETS = 4;
/** Of the power spectrum, so that a sine of amplitude 1 has a power of 1, all its bands together. */
const SCALE = 4 / (1.5 * WINDOW * SIZE);

export class Ear {
  private readonly recent = new Float32Array(WINDOW);
  /** How many of the next hop's samples are there. */
  private filled = 0;
  private loudest = QUIETEST;
  private readonly window = Float64Array.from({ length: WINDOW }, (_, k) => 0.5 - 0.5 * Math.cos((2 * Math.PI * k) / WINDOW));
  private readonly bands = melBands();
  private readonly real = new Float64Array(SIZE);
  private readonly imaginary = new Float64Array(SIZE);

  /** Takes samples at `RATE`; `hear` gets each row that they complete, its own array. */
  push(samples: Float32Array, hear: (row: Float32Array) => void): void {
    for (let at = 0; at < samples.length;) {
      const count = Math.min(HOP - this.filled, samples.length - at);
      this.recent.copyWithin(0, count);
      this.recent.set(samples.subarray(at, at + count), WINDOW - count);
      at += count;
      this.filled += count;
      if (this.filled < HOP) continue;
      this.filled = 0;
      hear(this.row());
    }
  }

  private row(): Float32Array {
    const { real, imaginary } = this, power = new Float64Array(BANDS);
    real.fill(0);
    imaginary.fill(0);
    for (let k = 0; k < WINDOW; ++k) real[k] = this.recent[k] * this.window[k];
    transform(real, imaginary);
    let whole = 0;
    this.bands.forEach(({ first, weights }, band) => {
      let sum = 0;
      for (let k = 0; k < weights.length; ++k) sum += weights[k] * (real[first + k] ** 2 + imaginary[first + k] ** 2);
      whole += power[band] = SCALE * sum;
    });
    const loudness = 10 * Math.log10(whole + FLOOR);
    this.loudest = Math.max(loudness, QUIETEST, this.loudest);
    const row = Float32Array.from(power, (value) => Math.max(10 * Math.log10(value + FLOOR) - this.loudest + 40, -40) / 20);
    this.loudest -= (FORGETS * HOP) / RATE;
    return row;
  }
}

/** Triangles even in mel: where each begins among the frequencies of the transform, and its weights. */
function melBands(): { first: number; weights: Float64Array }[] {
  const mel = (hertz: number) => 1127 * Math.log1p(hertz / 700), from = mel(LOWEST), step = (mel(HIGHEST) - from) / (BANDS + 1);
  const edge = (k: number) => 700 * Math.expm1((from + k * step) / 1127);
  return Array.from({ length: BANDS }, (_, band) => {
    const [low, middle, high] = [edge(band), edge(band + 1), edge(band + 2)], weights: number[] = [];
    const first = Math.ceil((low * SIZE) / RATE);
    for (let k = first; (k * RATE) / SIZE < high; ++k) {
      const hertz = (k * RATE) / SIZE;
      weights.push(Math.max(Math.min((hertz - low) / (middle - low), (high - hertz) / (high - middle)), 0));
    }
    return { first, weights: Float64Array.from(weights) };
  });
}

const turns = (of: (angle: number) => number) => Float64Array.from({ length: SIZE / 2 }, (_, k) => of((-2 * Math.PI * k) / SIZE));
const COSINES = turns(Math.cos), SINES = turns(Math.sin);

/** The discrete Fourier transform of `SIZE` numbers in place (Cooley and Tukey 1965). */
function transform(real: Float64Array, imaginary: Float64Array): void {
  const count = SIZE;
  for (let i = 1, j = 0; i < count; ++i) {
    let bit = count >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) {
      [real[i], real[j]] = [real[j], real[i]];
      [imaginary[i], imaginary[j]] = [imaginary[j], imaginary[i]];
    }
  }
  for (let half = 1; half < count; half *= 2) {
    for (let k = 0; k < half; ++k) {
      const turn = (k * SIZE) / (2 * half), c = COSINES[turn], s = SINES[turn];
      for (let a = k; a < count; a += 2 * half) {
        const b = a + half, x = real[b] * c - imaginary[b] * s, y = real[b] * s + imaginary[b] * c;
        real[b] = real[a] - x;
        imaginary[b] = imaginary[a] - y;
        real[a] += x;
        imaginary[a] += y;
      }
    }
  }
}
