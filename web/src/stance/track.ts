/** A curve through time of minimum-jerk moves between values (`avatar.speech.tracks.Track`). */

/** A quintic from a state to a value at rest, in the time since its start: six coefficients a value. */
interface Move {
  start: number;
  end: number;
  coefficients: readonly Float64Array[];
}

export class Track {
  private moves: Move[] = [];

  /** @param first value before the first move. */
  constructor(private first: Float64Array) {}

  /** The end of the last move, seconds. */
  get end(): number {
    return this.moves.at(-1)?.end ?? 0;
  }

  /** The value at the end of the last move. */
  get target(): Float64Array {
    return this.at(this.end);
  }

  /** Moves to a value, from the state that there is at the start; moves planned for later are forgotten. */
  move(target: Float64Array, start: number, end: number): void {
    this.discardFrom(start);
    const [place, speed, push] = [0, 1, 2].map((order) => this.at(start, order)), T = end - start, of = target.map((value, i) => value - place[i]);
    const mixed = (a: number, b: number, c: number, power: number) => of.map((delta, i) => (a * delta + b * speed[i] * T + c * push[i] * T * T) / (2 * T ** power));
    const coefficients = [place, speed, push.map((value) => value / 2), mixed(20, -12, -3, 3), mixed(-30, 16, 3, 4), mixed(12, -6, -1, 5)];
    this.moves.push({ start, end, coefficients });
  }

  /** Forgets the moves that begin at a time or later. */
  discardFrom(start: number): void {
    while (this.moves.length && this.moves.at(-1)!.start >= start) this.moves.pop();
  }

  /** Forgets moves that matter for times before `time` alone. */
  discardBefore(time: number): void {
    while (this.moves.length > 1 && this.moves[1].start <= time) this.first = valueOf(this.moves.shift()!, Infinity, 0);
  }

  /** The value at a time, seconds; its derivative of an order. */
  at(time: number, order = 0): Float64Array {
    // Each time belongs to the last move that has begun by then.
    let last: Move | undefined;
    for (const one of this.moves) if (one.start <= time) last = one;
    return last ? valueOf(last, time, order) : order ? new Float64Array(this.first.length) : this.first;
  }
}

function valueOf({ start, end, coefficients }: Move, time: number, order: number): Float64Array {
  const out = new Float64Array(coefficients[0].length), t = Math.min(Math.max(time, start), end) - start;
  if (order && time >= end) return out;
  coefficients.forEach((values, k) => {
    // The derivative of t^k.
    let factor = k < order ? 0 : t ** (k - order);
    for (let j = 0; j < order; ++j) factor *= k - j;
    for (let i = 0; i < out.length; ++i) out[i] += factor * values[i];
  });
  return out;
}
