/** The network's mouth without jitter, and with lips that close: `smooth_mouth` of `avatar.speech.lips`, row by row. */

import { ARTICULATORS } from "./network.ts";

const FOLLOWS = 0.5, OPEN = 0.3, CLOSED = 0.6;
const JAW = 0, PRESS = 1;

export class Steady {
  private readonly mean = new Float64Array(ARTICULATORS);

  /** The mouth as it is shown, of the next row's. */
  push(mouth: ArrayLike<number>): Float32Array {
    for (let k = 0; k < ARTICULATORS; ++k) this.mean[k] += FOLLOWS * (mouth[k] - this.mean[k]);
    const out = Float32Array.from(this.mean), x = Math.min(Math.max((out[PRESS] - OPEN) / (CLOSED - OPEN), 0), 1);
    const closed = x * x * (3 - 2 * x);
    out[PRESS] = Math.max(out[PRESS], closed);
    out[JAW] *= 1 - closed;
    return out;
  }
}
