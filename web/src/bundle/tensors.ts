/** Tensors in the layout of safetensors (`smplxpp/core/files/tensor_bytes.py`): a JSON object behind its length, then the numbers. */

import { floatsFromHalves } from "../math/half.ts";
import { BundleError, EXPORT_AGAIN } from "./errors.ts";
import { asInteger, asList, asObject, asText, parseJson } from "./json.ts";

type Numbers =
  | Float64Array | Float32Array | Int32Array | Int16Array | Int8Array | Uint32Array | Uint16Array | Uint8Array;

export interface Tensor {
  dtype: string;
  shape: number[];
  /** Halves as the floats that they stand for, integers of 64 bits as doubles. */
  values: Numbers;
}

const KINDS = new Map<string, { bytes: number; make: (buffer: ArrayBuffer) => Numbers }>(Object.entries({
  F64: { bytes: 8, make: (buffer: ArrayBuffer) => new Float64Array(buffer) },
  F32: { bytes: 4, make: (buffer: ArrayBuffer) => new Float32Array(buffer) },
  F16: { bytes: 2, make: (buffer: ArrayBuffer) => floatsFromHalves(new Uint16Array(buffer)) },
  I64: { bytes: 8, make: (buffer: ArrayBuffer) => Float64Array.from(new BigInt64Array(buffer), Number) },
  I32: { bytes: 4, make: (buffer: ArrayBuffer) => new Int32Array(buffer) },
  I16: { bytes: 2, make: (buffer: ArrayBuffer) => new Int16Array(buffer) },
  I8: { bytes: 1, make: (buffer: ArrayBuffer) => new Int8Array(buffer) },
  U64: { bytes: 8, make: (buffer: ArrayBuffer) => Float64Array.from(new BigUint64Array(buffer), Number) },
  U32: { bytes: 4, make: (buffer: ArrayBuffer) => new Uint32Array(buffer) },
  U16: { bytes: 2, make: (buffer: ArrayBuffer) => new Uint16Array(buffer) },
  U8: { bytes: 1, make: (buffer: ArrayBuffer) => new Uint8Array(buffer) },
  BOOL: { bytes: 1, make: (buffer: ArrayBuffer) => new Uint8Array(buffer) },
}));

const METADATA = "__metadata__", LONGEST_HEADER = 2 ** 20, MOST_AXES = 8;

/** The tensors of a piece by name, and what else it says. */
export interface Piece {
  tensors: Map<string, Tensor>;
  about: Record<string, unknown>;
}

/** Takes a piece apart. @throws BundleError anything but tensors that fill the data without holes, each of its kind and shape. */
export function unpackTensors(data: Uint8Array<ArrayBuffer>, subject: string): Piece {
  const wrong = (received: string) => new BundleError(subject, "tensors one behind the other behind a header", received, EXPORT_AGAIN);
  const length = data.length < 8 ? Infinity : Number(new DataView(data.buffer, data.byteOffset).getBigUint64(0, true));
  if (length > Math.min(LONGEST_HEADER, data.length - 8)) throw wrong(`${data.length} bytes of something else`);
  const header = asObject(parseJson(data.subarray(8, 8 + length), subject), subject), most = data.length - 8 - length;
  const tensors = new Map<string, Tensor>(), spans: number[][] = [];
  for (const [name, value] of Object.entries(header)) {
    if (name === METADATA) continue;
    const own = `${subject}: ${name}`, entry = asObject(value, own), dtype = asText(entry.dtype, own), kind = KINDS.get(dtype);
    const shape = asList(entry.shape, own).map((n) => asInteger(n, own, 0, most));
    const span = asList(entry.data_offsets, own).map((n) => asInteger(n, own, 0)), [first, last] = span;
    const size = shape.reduce((product, n) => product * n, kind?.bytes ?? NaN);
    if (span.length !== 2 || shape.length > MOST_AXES || !(last <= most && last - first === size)) throw wrong(`a damaged ${name}`);
    const start = data.byteOffset + 8 + length + first, values = kind!.make(data.buffer.slice(start, start + size));
    if (dtype === "BOOL" && values.some((one) => one > 1)) throw wrong(`bools of ${name} that are none`);
    tensors.set(name, { dtype, shape, values });
    spans.push([first, last]);
  }
  let end = 0;
  for (const [first, last] of spans.sort(([a, b], [c, d]) => a - c || b - d)) {
    if (first !== end) throw wrong("holes, or shared bytes");
    end = last;
  }
  if (end !== most) throw wrong(`${most} bytes in the place of ${end}`);
  const { about } = asObject(header[METADATA] ?? {}, subject);
  return { tensors, about: about === undefined ? {} : asObject(parseJson(asText(about, subject), subject), subject) };
}
