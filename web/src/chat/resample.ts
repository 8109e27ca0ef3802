/** A stream of samples to a lower rate, what that rate cannot hold filtered out. */

/** Zero crossings of the sinc on either side. */
const CROSSINGS = 12;

export class Resampler {
  private left = new Float32Array(0);
  /** Of the next sample that is given, in samples of `left`. */
  private at: number;
  private readonly step: number;
  private readonly half: number;

  constructor(from: number, readonly to: number) {
    this.step = from / to;
    this.half = Math.ceil(CROSSINGS * Math.max(1, this.step));
    this.at = 0;
    this.left = new Float32Array(this.half);
    this.at = this.half;
  }

  /** The next samples, at the new rate; the last of them come with the next call. */
  push(samples: Float32Array): Float32Array {
    const whole = new Float32Array(this.left.length + samples.length);
    whole.set(this.left);
    whole.set(samples, this.left.length);
    const out: number[] = [], wide = Math.max(1, this.step);
    for (; this.at + this.half < whole.length; this.at += this.step) {
      const middle = Math.floor(this.at);
      let sum = 0, weights = 0;
      for (let k = middle - this.half + 1; k <= middle + this.half; ++k) {
        const x = (k - this.at) / wide;
        if (Math.abs(x) >= CROSSINGS) continue;
        const weight = (x === 0 ? 1 : Math.sin(Math.PI * x) / (Math.PI * x)) * (0.5 + 0.5 * Math.cos((Math.PI * x) / CROSSINGS));
        sum += weight * whole[k];
        weights += weight;
      }
      out.push(sum / weights);
    }
    const used = Math.max(0, Math.floor(this.at) - this.half);
    this.left = whole.slice(used);
    this.at -= used;
    return Float32Array.from(out);
  }
}
