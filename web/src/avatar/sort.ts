/** Gaussians by their depth, nearest first. */

const BINS = 65536;

/** Sorts by depth in 16 bits, a counting sort; keeps its memory. */
export class DepthSorter {
  /** Least and largest depth of the last sort, metres. */
  range: [number, number] = [0, 1];
  private readonly counts = new Uint32Array(BINS + 1);
  private readonly keys: Uint16Array;
  private readonly shown: Uint32Array;
  private readonly order: Uint32Array;
  private readonly depths: Float32Array;

  constructor(count: number) {
    this.keys = new Uint16Array(count);
    this.shown = new Uint32Array(count);
    this.order = new Uint32Array(count);
    this.depths = new Float32Array(count);
  }

  /**
   * Returns those before the camera's near plane whose part is shown; the array is valid until the next call.
   *
   * @param centers (N, 3) metres. @param row the third row of the camera's rotation, and the z of its translation.
   * @param parts of every Gaussian. @param hidden parts that are not drawn.
   * @param sorted false: as they come, for a renderer that sorts.
   */
  sort(
    centers: Float32Array, row: ArrayLike<number>, near: number, parts: Uint8Array, hidden: ReadonlySet<number>,
    sorted = true,
  ): Uint32Array {
    const { depths, shown, keys, counts, order } = this;
    let count = 0, least = Infinity, most = -Infinity;
    for (let i = 0; i < depths.length; ++i) {
      const z = row[0] * centers[3 * i] + row[1] * centers[3 * i + 1] + row[2] * centers[3 * i + 2] + row[3];
      if (!(z >= near) || hidden.has(parts[i])) continue;
      depths[count] = z;
      shown[count++] = i;
      if (z < least) least = z;
      if (z > most) most = z;
    }
    this.range = count ? [least, most] : [0, 1];
    if (!sorted) return shown.subarray(0, count);
    const scale = most > least ? (BINS - 1) / (most - least) : 0;
    counts.fill(0);
    for (let k = 0; k < count; ++k) {
      keys[k] = (depths[k] - least) * scale;
      ++counts[keys[k] + 1];
    }
    for (let bin = 0; bin < BINS; ++bin) counts[bin + 1] += counts[bin];
    for (let k = 0; k < count; ++k) order[counts[keys[k]]++] = shown[k];
    return order.subarray(0, count);
  }
}
