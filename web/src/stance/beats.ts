/** Beats of a speech: the syllables that a gesture marks (`avatar.speech.gesture_planner.find_beats`). */

import type { Phone } from "../lips/visemes.ts";

const SILENCE = "SIL", VOWEL = /^[AEIOU]/;
/** Seconds of a vowel that counts as stressed, where none is known to be. */
const STRESSED = 0.06;
/** Seconds of silence after which a phrase begins. */
const PAUSE = 0.2;
/** Seconds from a vowel's onset to its beat: its loudness has risen by then. */
const RISEN = 0.04;
/** Seconds of a step of a sound's loudness, over which it is smoothed, and between two syllables at least. */
const STEP = 0.01, SMOOTH = 0.06, APART = 0.16;
/** Share of the loudest twentieth from which on a sound is a syllable. */
const LOUD = 0.3;
/** Seconds of a syllable that is as loud as the loudest; a quieter one is shorter. */
const LONGEST = 0.16;

/** A syllable, how strongly it is spoken, 0 to 1, and whether the stroke of a new gesture falls on it. */
export interface Beat {
  time: number;
  weight: number;
  stroke: boolean;
}

/** What is drawn by chance. */
export interface Chance {
  uniform(low: number, high: number): number;
  normal(): number;
  /** The numbers below `count` in any order. */
  shuffled(count: number): number[];
}

/** Beats in order of time. @param interval seconds between two of them at least. @param strokes seconds between two strokes. */
export function beatsOf(phones: readonly Phone[], interval: number, strokes: readonly [number, number], chance: Chance): Beat[] {
  const stressed = phones.filter(({ name, start, end }) => VOWEL.test(name) && end - start >= STRESSED - 1e-9);
  if (!stressed.length) return [];
  const lengths = stressed.map(({ start, end }) => end - start).sort((a, b) => a - b), half = lengths.length >> 1;
  const usual = lengths.length % 2 ? lengths[half] : (lengths[half - 1] + lengths[half]) / 2;
  // The longest ones first: of two that are near each other the longer one has the beat.
  const chosen: Phone[] = [];
  for (const one of [...stressed].sort((a, b) => a.start - a.end - b.start + b.end)) {
    if (chosen.every(({ start }) => Math.abs(start - one.start) >= interval)) chosen.push(one);
  }
  chosen.sort((a, b) => a.start - b.start);
  const starts = phraseStarts(phones);
  let last = -Infinity, wait = 0, phrase = -1;
  return chosen.map(({ start, end }) => {
    const time = Math.min(start + RISEN, (start + end) / 2), own = starts.filter((begin) => begin < start + 1e-6).length - 1;
    const stroke = time - last >= wait || (own !== phrase && time - last >= strokes[0]);
    if (stroke) [last, wait, phrase] = [time, chance.uniform(...strokes), own];
    return { time, weight: Math.min(Math.max((end - start) / usual, 0.6), 1.4) / 1.4, stroke };
  });
}

function phraseStarts(phones: readonly Phone[]): number[] {
  const out: number[] = [];
  let quiet = -Infinity;
  for (const { name, start, end } of phones) {
    if (name === SILENCE) continue;
    if (start - quiet >= PAUSE || !out.length) out.push(start);
    quiet = end;
  }
  return out;
}

/** The syllables of a sound of which nothing is known, by its loudness: vowels, with consonants between those of a phrase. */
export function syllablesOf(sound: AudioBuffer): Phone[] {
  const hop = Math.round(STEP * sound.sampleRate), count = Math.floor(sound.length / hop), power = new Float64Array(count);
  for (let c = 0; c < sound.numberOfChannels; ++c) {
    const samples = sound.getChannelData(c);
    for (let k = 0; k < count * hop; ++k) power[Math.floor(k / hop)] += samples[k] ** 2;
  }
  const reach = Math.round(SMOOTH / STEP / 2), loud = power.map((_, k) => {
    const near = power.subarray(Math.max(k - reach, 0), k + reach + 1);
    return Math.sqrt(near.reduce((sum, value) => sum + value, 0) / near.length);
  });
  const top = [...loud].sort((a, b) => b - a)[Math.floor(count / 20)] ?? 0, far = Math.round(APART / STEP), phones: Phone[] = [];
  for (let k = 0; k < count; ++k) {
    const before = loud.subarray(Math.max(k - far, 0), k), after = loud.subarray(k + 1, k + far + 1);
    if (!(loud[k] > LOUD * top) || before.some((value) => value >= loud[k]) || after.some((value) => value > loud[k])) continue;
    const length = LONGEST * Math.max(Math.min(loud[k] / top, 1), 0.4), start = Math.max(k * STEP - length / 2, 0), last = phones.at(-1);
    if (last && start - last.end < 2 * PAUSE) phones.push({ name: "T", start: last.end, end: Math.max(start, last.end) });
    phones.push({ name: "AH", start, end: start + length });
  }
  return phones;
}
