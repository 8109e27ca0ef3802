/** JSON as `smplxpp/core/files/json_file.py` reads it: UTF-8, bounded depth, bounded integers, whole characters; values by kind. */

import { BundleError, EXPORT_AGAIN } from "./errors.ts";

const MOST_LEVELS = 64, LONGEST_INTEGER = 19, LARGEST_INTEGER = 2 ** 53;
const TEXTS_AND_NUMBERS = /"[^"\\]*(?:\\.[^"\\]*)*"|-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?/g;
/** NUL, and halves of a surrogate pair. */
const UNUSABLE = /[\0\ud800-\udfff]/u;

/** Parses a text or its bytes. @throws BundleError what is no such JSON. */
export function parseJson(data: Uint8Array | string, subject: string): unknown {
  let value: unknown, text: string;
  try {
    text = typeof data === "string" ? data : new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(data);
    value = JSON.parse(text);
  } catch {
    throw new BundleError(subject, "JSON", "another thing", EXPORT_AGAIN);
  }
  for (const [token] of text.matchAll(TEXTS_AND_NUMBERS)) {
    if (token[0] !== '"' && token.length > LONGEST_INTEGER && !/[.eE]/.test(token)) {
      throw new BundleError(subject, "JSON", `an integer of ${token.length} digits`, EXPORT_AGAIN);
    }
  }
  // A layer at a time, so that no recursion is needed.
  let layer = [value];
  for (let level = 0; layer.length; ++level) {
    const inside = layer.filter((one) => typeof one === "object" && one !== null) as object[];
    if (inside.length && level >= MOST_LEVELS) throw new BundleError(subject, `JSON of at most ${MOST_LEVELS} levels`, "more", EXPORT_AGAIN);
    const texts = [...layer, ...inside.flatMap((one) => (Array.isArray(one) ? [] : Object.keys(one)))];
    if (texts.some((one) => typeof one === "string" && UNUSABLE.test(one))) {
      throw new BundleError(subject, "text of whole characters", "a NUL or half a character", EXPORT_AGAIN);
    }
    layer = inside.flatMap((one) => Object.values(one) as unknown[]);
  }
  return value;
}

export function asObject(value: unknown, subject: string): Record<string, unknown> {
  if (typeof value !== "object" || value === null || Array.isArray(value)) throw wrong(subject, "an object {...}", value);
  return value as Record<string, unknown>;
}

export function asList(value: unknown, subject: string): unknown[] {
  if (!Array.isArray(value)) throw wrong(subject, "a list [...]", value);
  return value;
}

export function asText(value: unknown, subject: string): string {
  if (typeof value !== "string") throw wrong(subject, "a text", value);
  return value;
}

export function asBoolean(value: unknown, subject: string): boolean {
  if (typeof value !== "boolean") throw wrong(subject, "true or false", value);
  return value;
}

/** A finite number within bounds. */
export function asNumber(value: unknown, subject: string, least: number, most: number): number {
  if (typeof value !== "number" || !Number.isFinite(value) || value < least || value > most) {
    throw wrong(subject, `a number from ${least} to ${most}`, value);
  }
  return value;
}

/** A whole number within bounds, such as 3.0. */
export function asInteger(value: unknown, subject: string, least: number, most = LARGEST_INTEGER): number {
  if (!Number.isInteger(value)) throw wrong(subject, "a whole number", value);
  return asNumber(value, subject, least, most);
}

function wrong(subject: string, expected: string, value: unknown): BundleError {
  return new BundleError(subject, expected, String(JSON.stringify(value)).slice(0, 80), EXPORT_AGAIN);
}
