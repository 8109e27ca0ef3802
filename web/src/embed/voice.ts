/** What an avatar says: a sound that is heard while the mouth follows it, by visemes where they are known. */

import type { Mouth } from "../animator.ts";
import type { Pose } from "../avatar/avatar.ts";
import type { SpeakingFace } from "../lips/face.ts";
import type { LiveLips } from "../lips/lips.ts";
import { spelt } from "../lips/spelling.ts";
import { articulate, phonesOf, type Phone, type Viseme } from "../lips/visemes.ts";
import { Playing } from "../sound/playing.ts";
import { syllablesOf } from "../stance/beats.ts";
import { bytesOf, type Source } from "./source.ts";

/** A sound, the visemes of it, or both; without a sound the mouth moves silently. */
export interface Utterance {
  audio?: Source | AudioBuffer | MediaStream;
  visemes?: readonly Viseme[];
}

/** Turns a text into an utterance, by whatever service the page has. */
export type TextToSpeech = (text: string, signal: AbortSignal) => Utterance | Promise<Utterance>;

/** A text as the browser says it. */
export interface BrowserVoice {
  /** BCP 47, such as "en-GB"; left out: the page's language. */
  language?: string;
  /** Of `speechSynthesis.getVoices()`. */
  name?: string;
  /** 1: as fast as the voice is by itself. */
  rate?: number;
}

/** Seconds until sound begins that is asked for now, that a browser may take to wake its sound, to list its voices, to begin. */
const SOON = 0.06, WAKES = 1, LISTED = 1.5, BEGINS = 10;
/** Seconds in which the mouth closes after the last viseme of a speech without sound. */
const CLOSES = 0.15;
/** Seconds by which a browser's word may come at another time than hands were told. */
const APART = 0.3;
const NEEDS_LIPS = "give createAvatar `lips`: the lips.safetensors that smplxpp web writes beside the avatar";
const NEEDS_CLICK = "this browser plays no sound before somebody has clicked or typed: call say from such an event";

/** Who moves her hands with what is said. */
export interface Hands {
  /** Plans gestures for what is said from now on, of which so many seconds are heard already. */
  plan(phones: readonly Phone[], heard: number): void;
  retract(): void;
}

/** What is said now. */
interface Now {
  phones: Phone[];
  /** Seconds since it began. */
  clock: () => number;
}

export class Voice implements Mouth {
  lips: LiveLips | null = null;
  face: SpeakingFace | null = null;
  hands: Hands | null = null;
  tts: TextToSpeech | BrowserVoice = {};
  context: AudioContext | null = null;
  /** What everything that is heard passes, for who wants to look at it. */
  output: GainNode | null = null;
  private now: Now | null = null;
  private halt: AbortController | null = null;
  /** Browsers forget what nobody holds, its events too. */
  protected spoken: SpeechSynthesisUtterance | null = null;

  get on(): boolean {
    return this.now !== null && this.face !== null;
  }

  pose(pose: Pose): Pose {
    const { now, face } = this;
    return now && face ? face.pose(articulate(now.phones, now.clock()), pose) : pose;
  }

  /**
   * Says something to its end; what is being said ends at once.
   *
   * @param began is called when it begins to be heard. @returns false: it was ended before. @throws Error it cannot be said.
   */
  async say(what: string | Utterance, began: () => void): Promise<boolean> {
    this.hush();
    const halt = (this.halt = new AbortController()), { signal } = halt, { tts } = this;
    try {
      if (typeof what !== "string") await this.utter(what, signal, began);
      else if (typeof tts === "function") await this.utter(await tts(what, signal), signal, began);
      else await this.browse(what, tts, signal, began);
      return !signal.aborted;
    } catch (error) {
      if (signal.aborted) return false;
      throw error;
    } finally {
      if (this.halt === halt) this.clear();
    }
  }

  /** Silence at once. */
  hush(): void {
    this.halt?.abort();
    this.clear();
  }

  dispose(): void {
    this.hush();
    void this.context?.close();
    this.context = this.output = null;
  }

  private clear(): void {
    if (this.halt) this.hands?.retract();
    this.now = this.halt = this.spoken = null;
  }

  private async utter({ audio, visemes }: Utterance, signal: AbortSignal, began: () => void): Promise<void> {
    signal.throwIfAborted();
    const phones = visemes && phonesOf(visemes);
    if (phones && !this.face) throw new Error(`the face of this avatar is not known; ${NEEDS_LIPS}`);
    if (audio instanceof MediaStream) return this.follow((lips) => lips.listen(audio), signal, began);
    if (audio !== undefined) {
      const context = await this.wake();
      const sound = audio instanceof AudioBuffer ? audio : await context.decodeAudioData(await bytesOf(audio, signal)).catch((error: Error) => {
        throw error.name === "EncodingError" ? new Error("this sound is damaged, or no kind that this browser plays") : error;
      });
      signal.throwIfAborted();
      if (!phones) {
        if (this.lips) this.lips.context = context;
        return this.follow((lips) => lips.play(sound, "this sound"), signal, () => {
          this.hands?.plan(syllablesOf(sound), this.lips?.played ?? 0);
          began();
        });
      }
      const playing = Playing.of(context, sound, this.output!);
      playing.start(context.currentTime + SOON);
      this.now = { phones, clock: () => playing.heard() };
      this.hands?.plan(phones, -SOON);
      began();
      await until(signal, (done) => (playing.onended = done));
      return playing.stop();
    }
    if (!phones) throw new Error("say: expected a text, or {audio, visemes} with one of both at least, received neither");
    const started = performance.now(), over = Math.max(0, ...phones.map(({ end }) => end)) + CLOSES;
    this.now = { phones, clock: () => (performance.now() - started) / 1000 };
    this.hands?.plan(phones, 0);
    began();
    await until(signal, (done) => setTimeout(done, 1000 * over));
  }

  /** Moves the mouth by what is heard. */
  private async follow(listen: (lips: LiveLips) => Promise<string>, signal: AbortSignal, began: () => void): Promise<void> {
    const { lips } = this;
    if (!lips) throw new Error(`a sound without visemes moves no mouth; ${NEEDS_LIPS}, or visemes`);
    const wrong = await listen(lips);
    if (wrong) throw new Error(wrong);
    if (!signal.aborted) began();
    await until(signal, (done) => void lips.over.then(done));
    if (signal.aborted) lips.stop();
  }

  /** The browser's own voice: it tells where words begin, and the mouth follows their letters. */
  private async browse(text: string, { language, name, rate = 1 }: BrowserVoice, signal: AbortSignal, began: () => void): Promise<void> {
    const synthesis = globalThis.speechSynthesis as SpeechSynthesis | undefined, voices = await voicesOf(synthesis);
    signal.throwIfAborted();
    const voice = name === undefined ? null : voices.find((one) => one.name === name);
    if (!synthesis || !voices.length || voice === undefined) {
      throw new Error(`this browser has no voice${name && voices.length ? ` "${name}"` : ""} to say a text with; give createAvatar \`voice\`, a function that turns a text into {audio, visemes}`);
    }
    const spoken = (this.spoken = new SpeechSynthesisUtterance(text));
    spoken.voice = voice;
    spoken.lang = language ?? voice?.lang ?? document.documentElement.lang;
    spoken.rate = rate;
    let begun = 0;
    const clock = () => (performance.now() - begun) / 1000;
    let patience: ReturnType<typeof setTimeout> | undefined;
    try {
      await until(signal, (done, fail) => {
        patience = setTimeout(() => fail(new Error(`the browser's voice did not begin; ${NEEDS_CLICK}`)), 1000 * BEGINS);
        spoken.onstart = () => {
          clearTimeout(patience);
          begun = performance.now();
          this.now = { phones: spelt(text, 0, 0, rate), clock };
          this.hands?.plan(this.now.phones, 0);
          began();
        };
        spoken.onboundary = ({ name: what, charIndex }) => {
          if (what === "sentence" || !this.now) return;
          const now = clock(), before = this.now.phones.filter(({ start }) => start < now), after = spelt(text, charIndex, now, rate);
          // Hands are told of words that come at other times than was guessed.
          const guessed = this.now.phones[this.now.phones.length - after.length]?.start ?? now;
          this.now.phones = [...before.map((one) => ({ ...one, end: Math.min(one.end, now) })), ...after];
          if (Math.abs(guessed - now) > APART) this.hands?.plan(after.map((one) => ({ ...one, start: one.start - now, end: one.end - now })), 0);
        };
        spoken.onend = done;
        spoken.onerror = ({ error }) => fail(new Error(error === "not-allowed" ? NEEDS_CLICK : `the browser's voice failed: ${error}`));
        synthesis.speak(spoken);
      });
    } finally {
      clearTimeout(patience);
      if (signal.aborted) synthesis.cancel();
    }
  }

  /** The context, once it plays. @throws Error it does not. */
  private async wake(): Promise<AudioContext> {
    if (!this.context) {
      this.context = new AudioContext();
      this.output = this.context.createGain();
      this.output.connect(this.context.destination);
    }
    const { context } = this;
    // Without a click it is never settled.
    await Promise.race([context.resume(), pause(WAKES)]);
    if (context.state !== "running") throw new Error(NEEDS_CLICK);
    return context;
  }
}

function pause(seconds: number): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, 1000 * seconds));
}

/** Settled when something is done, or no more wanted. */
function until(signal: AbortSignal, start: (done: () => void, fail: (error: Error) => void) => void): Promise<void> {
  return new Promise((resolve, reject) => {
    if (signal.aborted) return resolve();
    signal.addEventListener("abort", () => resolve(), { once: true });
    start(resolve, reject);
  });
}

async function voicesOf(synthesis: SpeechSynthesis | undefined): Promise<SpeechSynthesisVoice[]> {
  // Browsers that fetch their list answer with none at first.
  if (synthesis && !synthesis.getVoices().length) {
    await Promise.race([new Promise((resolve) => synthesis.addEventListener("voiceschanged", resolve, { once: true })), pause(LISTED)]);
  }
  return synthesis?.getVoices() ?? [];
}
