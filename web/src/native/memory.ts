/** The kernels of `smplxpp/native`, compiled to WebAssembly, and the memory that they see. */

import bytes from "./kernels.wasm";

/** What the kernels export: addresses and counts; counts of 64 bits are bigints. */
type Kernel = (...values: (number | bigint)[]) => number;
type Numbers = Float64Array | Float32Array | Int32Array | Uint32Array | Int8Array | Uint8Array;
type Maker<A> = { new (buffer: ArrayBufferLike, at: number, count: number): A; readonly BYTES_PER_ELEMENT: number };

/** Numbers in the kernels' memory, which may move as it grows: `view` is good until the next call of a kernel. */
export class Block<A extends Numbers> {
  private made: A;

  constructor(private readonly memory: WebAssembly.Memory, private readonly make: Maker<A>, readonly at: number, readonly count: number) {
    this.made = new make(memory.buffer, at, count);
  }

  get view(): A {
    if (this.made.buffer !== this.memory.buffer) this.made = new this.make(this.memory.buffer, this.at, this.count);
    return this.made;
  }
}

let compiled: WebAssembly.Module | null = null;

/** One instance: its memory goes with it. */
export class Native {
  private readonly memory: WebAssembly.Memory;
  private readonly functions: Record<string, Kernel>;

  /** @throws Error the browser has no WebAssembly, or none with vectors. */
  constructor() {
    try {
      compiled ??= new WebAssembly.Module(bytes);
    } catch (error) {
      throw new Error("this browser has no WebAssembly with SIMD (browsers since spring 2023 have it, unless it is turned off)", { cause: error });
    }
    const { memory, ...functions } = new WebAssembly.Instance(compiled).exports;
    this.memory = memory as WebAssembly.Memory;
    this.functions = functions as Record<string, Kernel>;
    this.functions._initialize();
  }

  /** Room for some numbers, which are zero. */
  room<A extends Numbers>(make: Maker<A>, count: number): Block<A> {
    const at = this.functions.smplxpp_web_allocate(Math.max(1, make.BYTES_PER_ELEMENT * count)) >>> 0;
    if (!at) throw new Error("there is no memory left for this avatar");
    const block = new Block(this.memory, make, at, count);
    block.view.fill(0);
    return block;
  }

  /** Room for floats. */
  floats(count: number): Block<Float32Array> {
    return this.room(Float32Array, count);
  }

  /** A copy of an array. */
  keep<A extends Numbers>(array: A): Block<A> {
    const block = this.room(array.constructor as Maker<A>, array.length);
    block.view.set(array);
    return block;
  }

  /**
   * A structure of the kernels: 64-bit counts, then what is given for the other fields.
   *
   * @param fields blocks and null are pointers; [x] is a float.
   */
  struct(counts: number[], fields: (Block<Numbers> | null | [number])[]): Block<Uint8Array> {
    const block = this.room(Uint8Array, 8 * counts.length + 4 * fields.length + 8), { buffer } = block.view;
    const data = new DataView(buffer, block.at);
    counts.forEach((count, k) => data.setBigInt64(8 * k, BigInt(count), true));
    fields.forEach((field, k) => {
      const at = 8 * counts.length + 4 * k;
      if (Array.isArray(field)) data.setFloat32(at, field[0], true);
      else data.setUint32(at, field ? field.at : 0, true);
    });
    return block;
  }

  /** Runs a kernel: blocks and null are pointers, bigints counts of 64 bits. */
  run(name: string, ...values: (Block<Numbers> | null | number | bigint)[]): void {
    const plain = values.map((value) => (value === null ? 0 : typeof value === "object" ? value.at : value));
    const status = this.functions[`smplxpp_${name}`](...plain);
    if (status) throw new Error(`${name} of the kernels failed with ${status}`);
  }
}
