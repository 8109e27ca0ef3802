/** Tensors in the layout of safetensors: a JSON object behind its length, then the numbers. */

import { floatsFromHalves } from "../math/half.ts";
import { BundleError, EXPORT_AGAIN } from "./errors.ts";

type Numbers =
  | Float64Array | Float32Array | Int32Array | Int16Array | Int8Array | Uint32Array | Uint16Array | Uint8Array;

export interface Tensor {
  dtype: string;
  shape: number[];
  /** Halves as the floats that they stand for. */
  values: Numbers;
}

const KINDS: Record<string, { bytes: number; make: (buffer: ArrayBuffer) => Numbers }> = {
  F64: { bytes: 8, make: (buffer) => new Float64Array(buffer) },
  F32: { bytes: 4, make: (buffer) => new Float32Array(buffer) },
  F16: { bytes: 2, make: (buffer) => floatsFromHalves(new Uint16Array(buffer)) },
  I64: { bytes: 8, make: (buffer) => Int32Array.from(new BigInt64Array(buffer), Number) },
  I32: { bytes: 4, make: (buffer) => new Int32Array(buffer) },
  I16: { bytes: 2, make: (buffer) => new Int16Array(buffer) },
  I8: { bytes: 1, make: (buffer) => new Int8Array(buffer) },
  U32: { bytes: 4, make: (buffer) => new Uint32Array(buffer) },
  U16: { bytes: 2, make: (buffer) => new Uint16Array(buffer) },
  U8: { bytes: 1, make: (buffer) => new Uint8Array(buffer) },
  BOOL: { bytes: 1, make: (buffer) => new Uint8Array(buffer) },
};

const METADATA = "__metadata__";

/** The tensors of a piece by name, and what else it says. */
export interface Piece {
  tensors: Map<string, Tensor>;
  about: unknown;
}

/** Takes a piece apart. */
export function unpackTensors(data: Uint8Array<ArrayBuffer>, subject: string): Piece {
  const wrong = (received: string) => new BundleError(subject, "tensors behind a header", received, EXPORT_AGAIN);
  const length = data.length < 8 ? Infinity : Number(new DataView(data.buffer, data.byteOffset).getBigUint64(0, true));
  if (length > data.length - 8) throw wrong(`${data.length} bytes of something else`);
  let header: Record<string, { dtype?: string; shape?: number[]; data_offsets?: number[] }>;
  try {
    header = JSON.parse(new TextDecoder().decode(data.subarray(8, 8 + length)));
  } catch {
    throw wrong("a damaged header");
  }
  const tensors = new Map<string, Tensor>();
  let about: unknown;
  for (const [name, { dtype = "", shape = [], data_offsets: span = [] }] of Object.entries(header)) {
    if (name === METADATA) continue;
    const kind = KINDS[dtype], [first, last] = span;
    const size = shape.reduce((product, n) => product * n, 1) * (kind?.bytes ?? NaN);
    if (!(first >= 0 && last - first === size && last <= data.length - 8 - length)) throw wrong(`a damaged ${name}`);
    const start = data.byteOffset + 8 + length + first;
    tensors.set(name, { dtype, shape, values: kind.make(data.buffer.slice(start, start + size)) });
  }
  try {
    about = JSON.parse((header[METADATA] as { about?: string } | undefined)?.about ?? "null");
  } catch {
    throw wrong("a damaged description");
  }
  return { tensors, about };
}
