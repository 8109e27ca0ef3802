/**
 * Roughly how a word is said, by its letters: for voices of browsers, which tell where a word begins and no more. The mouth
 * opens for vowels and closes for bilabials; it is no pronunciation.
 */

import type { Phone } from "./visemes.ts";

/** Longest first; Latin letters without their accents, as English mostly says them. */
const LETTERS: [string, string][] = Object.entries({
  tion: "SH AH N", sch: "SH", igh: "AY", eau: "O", th: "TH", sh: "SH", ch: "CH", ph: "F", ng: "NG", qu: "K W", ck: "K", wh: "W", kn: "N", wr: "R",
  oo: "UW", ee: "IY", ea: "IY", ie: "IY", ou: "AW", ow: "OW", oi: "OY", oy: "OY", ai: "EY", ay: "EY", ei: "EY", ey: "EY", au: "AO", aw: "AO",
  er: "ER", ir: "ER", ur: "ER", ar: "AA R", or: "AO R", bb: "B", dd: "D", ff: "F", gg: "G", ll: "L", mm: "M", nn: "N", pp: "P", rr: "R", ss: "S", tt: "T",
  a: "AE", b: "B", c: "K", d: "D", e: "EH", f: "F", g: "G", h: "HH", i: "IH", j: "JH", k: "K", l: "L", m: "M", n: "N", o: "O", p: "P", q: "K", r: "R",
  s: "S", t: "T", u: "AH", v: "V", w: "W", x: "K S", y: "IY", z: "Z", "ß": "S", "æ": "AE", "ø": "ER", "œ": "ER", "đ": "D", "ł": "W", "ı": "IH",
  0: "Z IH R O", 1: "W AH N", 2: "T UW", 3: "TH R IY", 4: "F AO R", 5: "F AY V", 6: "S IH K S", 7: "S EH V EH N", 8: "EY T", 9: "N AY N",
});
const VOWEL = /^(A|E|I|O|U)/;
/** Seconds of a vowel, of a consonant, and of the gap behind a comma or a full stop, at a rate of 1. */
const OF_VOWEL = 0.1, OF_CONSONANT = 0.065, PAUSE = 0.25;

/** Words of a text with their places in it: scripts other than Latin open and close the mouth letter by letter. */
export function wordsOf(text: string): { at: number; names: string[]; pause: boolean }[] {
  return [...text.matchAll(/[\p{L}\p{N}][\p{L}\p{N}\p{M}'’]*/gu)].map((found) => {
    const after = text.slice(found.index + found[0].length);
    return { at: found.index, names: namesOf(found[0]), pause: /^["'”’)\]]*[,.;:!?…]/.test(after) };
  });
}

function namesOf(word: string): string[] {
  const plain = word.toLowerCase().normalize("NFD").replace(/[\p{M}'’]/gu, ""), names: string[] = [];
  for (let at = 0; at < plain.length;) {
    // The e of "make" is silent.
    if (plain[at] === "e" && at === plain.length - 1 && names.filter((name) => VOWEL.test(name)).length) break;
    const found = LETTERS.find(([letters]) => plain.startsWith(letters, at));
    names.push(...(found ? found[1].split(" ") : at % 2 ? ["N", "AA"] : ["AH"]));
    at += found ? found[0].length : String.fromCodePoint(plain.codePointAt(at)!).length;
  }
  return names;
}

/** Phonemes of a text from a place in it on, beginning at a time. */
export function spelt(text: string, from: number, start: number, rate: number): Phone[] {
  const phones: Phone[] = [];
  let time = start;
  for (const { at, names, pause } of wordsOf(text)) {
    if (at < from) continue;
    for (const name of names) {
      const end = time + (VOWEL.test(name) ? OF_VOWEL : OF_CONSONANT) / rate;
      phones.push({ name, start: time, end });
      time = end;
    }
    if (pause) time += PAUSE / rate;
  }
  return phones;
}
