/** Visemes of other programs as our phonemes, and the mouth that they make (`avatar.speech.coarticulation`). */

import { ARTICULATORS } from "./network.ts";

/** A mouth's shape and its seconds. */
export interface Viseme {
  /** One of `VISEME_NAMES`, or Azure's number. */
  viseme: string | number;
  start: number;
  /** Left out: where the next one begins. */
  end?: number;
}

/** A phoneme by its ARPAbet name, or "SIL". */
export interface Phone {
  name: string;
  start: number;
  end: number;
}

const JAW = 0, PRESS = 1, TUCK = 2, ROUND = 3, SPREAD = 4, BARE = 5;
type Shape = [articulator: number, target: number, dominance: number][];
const vowel = (jaw: number, round = 0, spread = 0): Shape => [[JAW, jaw, 1], [ROUND, round, 1], [SPREAD, spread, 1], [PRESS, 0, 1], [TUCK, 0, 1]];
const SILENCE: Shape = [0, 1, 2, 3, 4, 5].map((one) => [one, 0, 0.6]);
const BILABIAL: Shape = [[JAW, 0, 3], [PRESS, 1, 4], [TUCK, 0, 2], [BARE, 0, 2]];
const LABIODENTAL: Shape = [[JAW, 0.12, 2], [TUCK, 1, 4], [PRESS, 0, 2], [BARE, 0.2, 1]];
const DENTAL: Shape = [[JAW, 0.25, 0.8], [BARE, 0.3, 1], [PRESS, 0, 1]];
const ALVEOLAR: Shape = [[JAW, 0.18, 0.6], [BARE, 0.2, 0.5], [PRESS, 0, 0.8]];
const VELAR: Shape = [[JAW, 0.25, 0.4], [PRESS, 0, 0.8]];
const POSTALVEOLAR: Shape = [[JAW, 0.12, 1.2], [ROUND, 0.7, 1.5], [BARE, 0.5, 1.2], [PRESS, 0, 1]];
const SIBILANT: Shape = [[JAW, 0.08, 1.4], [SPREAD, 0.35, 0.6], [BARE, 0.5, 1.2], [PRESS, 0, 1]];
/** Targets and dominances; the test holds them against those of `avatar.speech`. */
const SHAPES: Record<string, Shape> = {
  SIL: SILENCE, P: BILABIAL, B: BILABIAL, M: BILABIAL, F: LABIODENTAL, V: LABIODENTAL, TH: DENTAL, DH: DENTAL,
  T: ALVEOLAR, D: ALVEOLAR, N: ALVEOLAR, L: ALVEOLAR, K: VELAR, G: VELAR, NG: VELAR, HH: VELAR,
  CH: POSTALVEOLAR, JH: POSTALVEOLAR, SH: POSTALVEOLAR, ZH: POSTALVEOLAR, S: SIBILANT, Z: SIBILANT,
  R: [[JAW, 0.22, 0.7], [ROUND, 0.5, 0.9], [PRESS, 0, 0.8]], W: [[JAW, 0.12, 1.2], [ROUND, 1, 2], [PRESS, 0, 1]],
  Y: [[JAW, 0.2, 0.7], [SPREAD, 0.5, 0.8], [PRESS, 0, 0.8]],
  AA: vowel(1), AE: vowel(0.85, 0, 0.3), AH: vowel(0.6), EH: vowel(0.6, 0, 0.3), IH: vowel(0.35, 0, 0.35), IY: vowel(0.22, 0, 0.7),
  ER: vowel(0.35, 0.5), AO: vowel(0.75, 0.55), UH: vowel(0.3, 0.6), UW: vowel(0.2, 1), E: vowel(0.45, 0, 0.5), O: vowel(0.5, 0.8),
};
const DIPHTHONGS: Record<string, [string, string]> = { AY: ["AA", "IH"], AW: ["AA", "UH"], EY: ["E", "IY"], OW: ["O", "UW"], OY: ["AO", "IH"] };
/** Seconds of a dominance's rise and decay, by which the mouth leads the sound, in which lips close; dominance of rest. */
const BEFORE = 0.07, AFTER = 0.05, LEAD = 0.02, CLOSING = 0.06, REST = 0.05;
/** Time constants beyond which a phoneme does not count; seconds of a picture in which a closure must be seen. */
const REACH = 12 * BEFORE, PICTURE = 1 / 30;
/** Seconds of a last viseme that has no end. */
const LAST = 0.12;

/** Oculus' names (`viseme_` before them or not), then Amazon Polly's where these differ. */
const NAMED: Record<string, string> = {
  sil: "SIL", PP: "P", FF: "F", TH: "TH", DD: "D", kk: "K", CH: "CH", SS: "S", nn: "N", RR: "R", aa: "AA", E: "EH", I: "IH", O: "AO", U: "UW",
  p: "P", t: "T", S: "SH", T: "TH", f: "F", k: "K", i: "IY", r: "R", s: "S", u: "UW", "@": "AH", a: "AA", e: "E", o: "O",
};
/** Azure's numbers 0 to 21. */
const AZURE = "SIL AH AA AO EH ER IY UW O AW OY AY HH R L S SH TH F T K P".split(" ");
/** What `Viseme.viseme` may be beside Azure's 0 to 21: Oculus', Polly's, and ARPAbet's names. */
export const VISEME_NAMES: readonly string[] = [...new Set([...Object.keys(NAMED), ...Object.keys(SHAPES), ...Object.keys(DIPHTHONGS)])];

/** Visemes as phonemes in order of time. @throws Error one that is none. */
export function phonesOf(visemes: readonly Viseme[]): Phone[] {
  const sorted = [...visemes].sort((a, b) => a.start - b.start);
  return sorted.map(({ viseme, start, end }, k) => {
    const given = typeof viseme === "string" ? viseme.replace(/^viseme_/, "") : viseme;
    const name = typeof given === "number" ? AZURE[given] : Object.hasOwn(NAMED, given) ? NAMED[given] : given;
    if (name === undefined || !(Object.hasOwn(SHAPES, name) || Object.hasOwn(DIPHTHONGS, name)) || !Number.isFinite(start)) {
      throw new Error(`visemes: expected {viseme, start} with Azure's 0 to 21 or one of ${VISEME_NAMES.join(" ")}, received ${JSON.stringify(visemes[k])}`);
    }
    return { name, start, end: end ?? sorted[k + 1]?.start ?? start + LAST };
  });
}

/** The articulators at a time, 0 to 1: `sum D T / (sum D + rest)`, lips closed for every bilabial. */
export function articulate(phones: readonly Phone[], time: number): Float32Array {
  const over = new Float64Array(ARTICULATORS), under = new Float64Array(ARTICULATORS).fill(REST);
  for (const { name, start, end } of parts(phones)) {
    const away = Math.max((start - LEAD - time) / BEFORE, (time - end + LEAD) / AFTER, 0);
    if (away * Math.min(BEFORE, AFTER) > REACH) continue;
    for (const [articulator, target, dominance] of SHAPES[name]) {
      const weight = dominance * Math.exp(-away);
      over[articulator] += weight * target;
      under[articulator] += weight;
    }
  }
  const mouth = Float32Array.from(over, (value, k) => value / under[k]);
  for (const { name, start, end } of phones) {
    const closes = SHAPES[name] === BILABIAL, tucks = SHAPES[name] === LABIODENTAL;
    if (!closes && !tucks) continue;
    const half = Math.max(0.35 * (end - start), 0.5001 * PICTURE);
    const away = Math.max(Math.abs(time - 0.5 * (start + end) + LEAD) - half, 0) / CLOSING;
    const held = away < 1 ? 0.5 + 0.5 * Math.cos(Math.PI * away) : 0;
    if (closes) {
      mouth[PRESS] = Math.max(mouth[PRESS], held);
      mouth[JAW] *= 1 - held;
    } else {
      mouth[TUCK] = Math.max(mouth[TUCK], held);
      mouth[JAW] = Math.min(mouth[JAW], 1 - 0.85 * held);
    }
  }
  return mouth;
}

/** Diphthongs as two vowels, silence before, after and between. */
function* parts(phones: readonly Phone[]): Generator<Phone> {
  yield { name: "SIL", start: -1, end: 0 };
  let last = 0;
  for (const one of phones) {
    if (one.start > last + 1e-6) yield { name: "SIL", start: last, end: one.start };
    const pair = DIPHTHONGS[one.name], middle = one.start + 0.6 * (one.end - one.start);
    if (pair) {
      yield { name: pair[0], start: one.start, end: middle };
      yield { name: pair[1], start: middle, end: one.end };
    } else yield one;
    last = one.end;
  }
  yield { name: "SIL", start: last, end: last + 1 };
}
