/** The mouth moved by live sound: of the microphone, or of a file that is played. All of it in the page. */

import type { Pose } from "../avatar/avatar.ts";
import { unpackTensors, type Piece } from "../bundle/tensors.ts";
import { Microphone } from "../chat/microphone.ts";
import { Resampler } from "../chat/resample.ts";
import { Playing } from "../sound/playing.ts";
import { SpeakingFace } from "./face.ts";
import { Ear, HOP, RATE } from "./features.ts";
import { ARTICULATORS, LipNetwork } from "./network.ts";
import { Steady } from "./steady.ts";

/** Samples of a piece of the microphone: a row's. */
const PIECE = HOP;
/** Seconds of a file that are heard ahead of what is played, and at most in one go. */
const AHEAD = 0.3, AT_ONCE = 2;
/** Seconds until a file begins. */
const SOON = 0.1;
/** Seconds of the mouth that are kept. */
const KEPT = 10;
/** Of full scale: what is louder is no silence; seconds of silence after which it is said. */
const LOUD = 3e-3, PATIENCE = 4;
/** Seconds in which the mouth closes when the sound is over. */
const CLOSES = 0.15;
const AT_REST = new Float32Array(ARTICULATORS);

/** Ear, network and smoothing of one sound, from its beginning on. */
class Hearing {
  readonly rows: Float32Array[] = [];
  /** How many have been forgotten before them. */
  private gone = 0;
  private readonly ear = new Ear();
  private readonly steady = new Steady();

  constructor(private readonly network: LipNetwork) {}

  push(samples: Float32Array): void {
    this.ear.push(samples, (row) => this.rows.push(this.steady.push(this.network.push(row).mouth)));
    for (; this.rows.length > (KEPT * RATE) / HOP; ++this.gone) this.rows.shift();
  }

  /** The mouth of a time of the sound, as far as it is known. */
  at(time: number): Float32Array {
    const at = Math.max(((time + this.network.delay) * RATE) / HOP - 1 - this.gone, 0), first = Math.floor(at), share = at - first;
    const low = this.rows[Math.min(first, this.rows.length - 1)] ?? AT_REST, high = this.rows[Math.min(first + 1, this.rows.length - 1)] ?? AT_REST;
    return low.map((value, k) => (1 - share) * value + share * high[k]);
  }
}

/** A file that is played. */
interface Played {
  mono: Float32Array;
  rate: number;
  resampler: Resampler;
  /** Samples that have been heard. */
  given: number;
  playing: Playing;
}

export class LiveLips {
  /** What is listened to; "" for nothing. */
  source = "";
  /** Told what is to be said on the page. */
  onsaid: (message: string) => void = () => {};
  context: AudioContext | null = null;
  /** What a file is heard through, for who wants to look at it. */
  output: GainNode | null = null;
  /** The network, and what the file says of face and stance. */
  readonly network: Piece;
  readonly face: SpeakingFace;
  /** Settled when what is listened to is over. */
  over: Promise<void> = Promise.resolve();
  private end: () => void = () => {};
  private microphone: Microphone | null = null;
  private hearing: Hearing | null = null;
  private file: Played | null = null;
  private lastLoud = 0;
  private quiet = false;
  /** Counts what was started: an answer that comes late is for nobody. */
  private turn = 0;
  private ended = -Infinity;
  private last: Float32Array = AT_REST;

  /** @throws BundleError another network than this version's, or a face of another body. */
  constructor(data: ArrayBuffer, expressions: number, jointNames: string[]) {
    this.network = unpackTensors(new Uint8Array(data), "the lips");
    new LipNetwork(this.network);
    this.face = new SpeakingFace(this.network, expressions, jointNames.indexOf("jaw"));
  }

  /** Whether the mouth is moved by it. */
  get on(): boolean {
    return this.source !== "" || performance.now() / 1000 - this.ended < CLOSES;
  }

  /** A pose with the mouth of what is heard now. */
  pose(pose: Pose): Pose {
    return this.face.pose(this.mouth(), pose);
  }

  /** The articulators now. */
  mouth(): Float32Array {
    const share = 1 - (performance.now() / 1000 - this.ended) / CLOSES;
    const { hearing, file } = this;
    if (!hearing) return share > 0 ? this.last.map((value) => value * share) : AT_REST;
    if (file) this.follow(file, hearing);
    else this.listened();
    return (this.last = file ? hearing.at(this.played) : hearing.rows.at(-1) ?? AT_REST);
  }

  /** Seconds of the file that have been heard. */
  get played(): number {
    return this.file?.playing.heard() ?? 0;
  }

  /** Listens to a stream, or to the microphone, and returns why it cannot, "" if it does. To be called by a click. */
  async listen(stream: MediaStream | null = null): Promise<string> {
    this.stop();
    const turn = ++this.turn, hearing = new Hearing(new LipNetwork(this.network)), microphone = new Microphone(PIECE);
    if (!stream) this.onsaid("The browser asks for the microphone");
    try {
      await microphone.start((samples) => this.hear(hearing, Float32Array.from(samples, (value) => value / 32767)), stream);
    } catch (error) {
      microphone.stop();
      return turn === this.turn ? this.say(`The microphone cannot be used: ${(error as Error).message}`) : "";
    }
    if (turn !== this.turn) {
      microphone.stop();
      return "";
    }
    this.microphone = microphone;
    this.hearing = hearing;
    this.begin("microphone");
    // A stream of somebody else's ends with its last sound.
    stream?.getAudioTracks().forEach((track) => track.addEventListener("ended", () => turn === this.turn && this.stop()));
    this.lastLoud = performance.now() / 1000;
    this.quiet = false;
    this.onsaid("Listening: speak");
    return "";
  }

  /** Plays a sound and moves the mouth by it; returns why it cannot, "" if it does. To be called by a click. */
  async play(data: ArrayBuffer | AudioBuffer, name: string): Promise<string> {
    this.stop();
    const turn = ++this.turn;
    this.onsaid(`Opening ${name}`);
    try {
      this.context ??= new AudioContext();
      void this.context.resume().catch(() => {}); // closed before it is awake
    } catch (error) {
      return this.say(`This browser plays no sound: ${(error as Error).message}`);
    }
    const { context } = this;
    const buffer = data instanceof AudioBuffer ? data : await context.decodeAudioData(data).catch(() => null);
    if (turn !== this.turn) return "";
    if (!buffer || !buffer.length) return this.say(`${name} is damaged, or no sound that this browser plays`);
    const mono = new Float32Array(buffer.length);
    for (let c = 0; c < buffer.numberOfChannels; ++c) {
      buffer.getChannelData(c).forEach((value, k) => (mono[k] += value / buffer.numberOfChannels));
    }
    if (!mono.some((value) => Math.abs(value) > LOUD)) return this.say(`${name} is silent`);
    this.output ??= context.createGain();
    this.output.connect(context.destination);
    const playing = Playing.of(context, buffer, this.output);
    playing.onended = () => this.file?.playing === playing && this.stop(`${name} is over`);
    this.hearing = new Hearing(new LipNetwork(this.network));
    this.file = { mono, rate: buffer.sampleRate, resampler: new Resampler(buffer.sampleRate, RATE), given: 0, playing };
    playing.start(context.currentTime + SOON);
    this.begin("file");
    this.onsaid(`Playing ${name}`);
    return "";
  }

  private begin(source: string): void {
    this.source = source;
    this.over = new Promise((resolve) => (this.end = resolve));
  }

  private say(message: string): string {
    this.onsaid(message);
    return message;
  }

  /** Listens no more, and gives back the loudspeakers. */
  dispose(): void {
    this.stop();
    void this.context?.close();
    this.context = null;
  }

  /** Listens no more: the mouth closes. */
  stop(said = ""): void {
    ++this.turn;
    this.microphone?.stop();
    this.file?.playing.stop();
    this.microphone = this.file = this.hearing = null;
    if (this.source) this.ended = performance.now() / 1000;
    this.source = "";
    this.end();
    this.onsaid(said);
  }

  /** Hears so much of the file that the mouth of what is played is known. */
  private follow(file: Played, hearing: Hearing): void {
    const { mono, rate, resampler, given } = file;
    file.given = Math.max(given, Math.min(Math.round((this.played + AHEAD) * rate), given + AT_ONCE * rate));
    // Behind its end it is silent.
    const piece = new Float32Array(file.given - given);
    piece.set(mono.subarray(given, file.given));
    hearing.push(resampler.push(piece));
  }

  private hear(hearing: Hearing, samples: Float32Array): void {
    hearing.push(samples);
    if (samples.some((value) => Math.abs(value) > LOUD)) this.lastLoud = performance.now() / 1000;
  }

  /** Says when nobody is heard, and when somebody is again. */
  private listened(): void {
    const quiet = performance.now() / 1000 - this.lastLoud > PATIENCE;
    if (quiet === this.quiet) return;
    this.quiet = quiet;
    this.onsaid(quiet ? "Nothing is heard: is the microphone muted?" : "Listening: speak");
  }
}
