/** The kernels of `smplxpp/native`, compiled to WebAssembly, and the memory that they see. */

import bytes from "./kernels.wasm";

declare const HELPER_SOURCE: string;

/** Bytes of a helper's stack: the field's kernel has its layers on it. */
const STACK = 1 << 18;

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

/** Of a page of memory, and how many there are at first, and at most: as the kernels are linked; shared memory is reserved whole. */
const FIRST = 16, MOST = 65535, MOST_SHARED = 16384;
/** Slices for each thread: who is faster, or less disturbed, takes more of them. */
const SLICES = 4;
const compiled = new Map<boolean, WebAssembly.Module>();

/** The kernels for memory that threads share, or for memory of one: one byte of the file says which. */
function moduleFor(shared: boolean): WebAssembly.Module {
  const made = compiled.get(shared);
  if (made) return made;
  const file = bytes.slice();
  file[flagAt()] = shared ? 3 : 1;
  const module = new WebAssembly.Module(file);
  compiled.set(shared, module);
  return module;
}

/** Where the file says what kind of memory it imports. */
function flagAt(): number {
  const name = "env\x06memory\x02";
  return String.fromCharCode(...bytes.subarray(0, 1024)).indexOf(name) + name.length;
}

/** One instance: its memory goes with it. */
export class Native {
  /** Threads that kernels run on, this one among them. */
  readonly threads: number;
  /** Into how many slices kernels are to cut their work. */
  readonly slices: number;
  /** What became of a helper that is gone; null: nothing. */
  lost: string | null = null;
  private readonly memory: WebAssembly.Memory;
  private readonly functions: Record<string, Kernel>;
  private readonly helpers: Worker[] = [];

  /**
   * @param threads more than one take a thread that may wait, and a page that may share memory (`crossOriginIsolated`).
   * @throws Error the browser has no WebAssembly, or none with vectors, or starts no threads.
   */
  constructor(threads = 1) {
    const shared = threads > 1;
    this.threads = threads;
    this.slices = shared ? SLICES * threads : 1;
    let module: WebAssembly.Module;
    try {
      module = moduleFor(shared);
    } catch (error) {
      throw new Error("this browser has no WebAssembly with SIMD (browsers since spring 2023 have it, unless it is turned off)", { cause: error });
    }
    this.memory = new WebAssembly.Memory({ initial: FIRST, maximum: shared ? MOST_SHARED : MOST, shared });
    this.functions = new WebAssembly.Instance(module, { env: { memory: this.memory } }).exports as Record<string, Kernel>;
    this.functions._initialize();
    if (shared) this.engage(module, threads - 1);
  }

  /** Slices that helpers have done. */
  get helped(): number {
    return this.functions.smplxpp_web_helped();
  }

  /** Ends the helpers; then nothing is to be run any more. */
  close(): void {
    for (const helper of this.helpers) helper.terminate();
  }

  /** Starts threads that help; until they are there, and should they never be, the work is done without them. */
  private engage(module: WebAssembly.Module, count: number): void {
    const url = URL.createObjectURL(new Blob([HELPER_SOURCE], { type: "text/javascript" }));
    for (let k = 0; k < count; ++k) {
      const helper = new Worker(url), stack = this.room(Uint8Array, STACK);
      this.helpers.push(helper);
      helper.onerror = (event) => {
        event.preventDefault();
        this.lost = event.message || "a thread did not start";
      };
      helper.postMessage({ module, memory: this.memory, stack: stack.at + STACK });
    }
    this.functions.smplxpp_web_helpers(count);
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
