/** An avatar that does what a page says: moves, poses, speaks; what draws it is somebody else's. */

import type { Animator } from "../animator.ts";
import type { Motion } from "../avatar/avatar.ts";
import { socketOf } from "../chat/connection.ts";
import { Dialogue } from "../chat/dialogue.ts";
import { WHITE, harmonicsOf } from "../light/irradiance.ts";
import { readRadiance } from "../light/radiance.ts";
import { SpeakingFace } from "../lips/face.ts";
import { LiveLips } from "../lips/lips.ts";
import type { Viseme } from "../lips/visemes.ts";
import { Soundtrack } from "../sound/soundtrack.ts";
import { Standing } from "../stance/standing.ts";
import type { Summary } from "../worker/protocol.ts";
import { bytesOf, type Source } from "./source.ts";
import { Voice, type BrowserVoice, type TextToSpeech, type Utterance } from "./voice.ts";

/** Seconds in which it goes over from a motion's pose to standing. */
const STANDS = 0.5;

export type { Summary, Source, Utterance, TextToSpeech, BrowserVoice };

/** What is opened, and what belongs to it. */
export interface AvatarFiles {
  /** The avatar's file, as smplxpp export or smplxpp web write it; left out: `open` is called later. */
  url?: Source;
  /** The lips.safetensors beside it: sounds without visemes, and visemes on bodies with numbered expressions, need it. */
  lips?: Source | null;
  /** The sound of the file's own motion, which then plays once, with `play`. */
  sound?: Source | null;
}

export interface AvatarOptions extends AvatarFiles, AvatarSettings {
  /** Says texts: a service of the page, or which of the browser's voices. */
  voice?: TextToSpeech | BrowserVoice;
  /** Plays the file's motion as soon as it is there, and again and again; a motion with a sound waits for `play`. Default: true. */
  autoplay?: boolean;
  /** Stands, breathes and moves its hands with what it says where no motion plays; `lips` tells how. Default: true. */
  gestures?: boolean;
  /** Address of the package's worker.js, for pages whose policy has no `worker-src blob:`. */
  worker?: string | URL;
  /** Disposes of the avatar. */
  signal?: AbortSignal;
}

/** What `set` changes; what is left out stays. */
export interface AvatarSettings {
  /** A panorama (.hdr) in whose light the avatar is shown; null: the light of its capture. */
  environment?: Source | null;
  /** Degrees about the vertical by which that light is turned. */
  environmentTurn?: number;
  /** Parts by name, shown or not. */
  parts?: Record<string, boolean>;
  /** Loose clothes are simulated. */
  simulate?: boolean;
}

/** Rotation vector (axis times angle, radians), or a place in metres. */
export type Vector = readonly [number, number, number];

/** What a pose holds in the motion's place; joints and expressions that are left out do what the motion does. */
export interface PoseParams {
  /** By name, or of all joints in their order. */
  joints?: Record<string, Vector> | readonly Vector[];
  /** By name, or of all in their order. */
  expression?: Record<string, number> | readonly number[];
  /** Of the pelvis from its place at rest, metres. */
  translation?: Vector;
}

/** Frames in turn. */
export interface MotionParams {
  framesPerSecond: number;
  /** Rotation vectors by frame and joint, in the order of `summary.jointNames`: joints that are left out at the end are at rest. */
  rotations: readonly (readonly Vector[])[];
  translation?: readonly Vector[];
  expression?: readonly (readonly number[])[];
}

export interface PlayOptions {
  /** Again from its beginning at its end. Default: true. */
  loop?: boolean;
  speed?: number;
  /** Seconds in which the pose goes over into the motion's first. Default: 0.3. */
  fade?: number;
}

export interface AvatarEvents {
  /** An avatar is open. */
  ready: Summary;
  /** A picture was drawn. */
  picture: { pictures: number; time: number };
  /** A motion that is not repeated has come to its end. */
  end: null;
  /** Something begins to be said; it is over, or was ended. */
  saying: string | Utterance;
  said: { what: string | Utterance; complete: boolean };
  error: AvatarError;
}

/** What went wrong beside what was asked for: with the avatar itself, the sound of its motion, or its lips. */
export class AvatarError extends Error {
  constructor(readonly about: "avatar" | "sound" | "lips", message: string) {
    super(message);
    this.name = "AvatarError";
  }
}

export class Avatar<P extends Animator = Animator> {
  /** What animates it, with all that can be set; null until `ready`, and after `dispose`. */
  player: P | null = null;
  /** What the open file holds: names of joints, expressions and parts, licence; null: none is open. */
  summary: Summary | null = null;
  /** Settled when the avatar of the options is open (without one: when `open` may be called), or with why it cannot be. */
  readonly ready: Promise<void>;
  protected readonly disposing = new AbortController();
  private readonly voice = new Voice();
  private readonly listeners = new Map<string, Set<(detail: never) => void>>();
  private sound: Soundtrack | null = null;
  private dialogue: Dialogue | null = null;
  /** How many conversations were asked for: the last one counts. */
  private asked = 0;
  private standing: Standing | null = null;

  /** @param make makes what animates the avatar. */
  constructor(make: (options: AvatarOptions) => Promise<P> | P, private readonly options: AvatarOptions = {}) {
    this.voice.tts = options.voice ?? {};
    options.signal?.addEventListener("abort", () => this.dispose(), { signal: this.disposing.signal });
    if (options.signal?.aborted) this.dispose();
    this.ready = this.start(make);
    // Who does not wait for it is told by the event.
    this.ready.catch((error: Error) => this.emit("error", new AvatarError("avatar", error.message)));
  }

  /** Opens another avatar, its lips and the sound of its motion. @throws Error what is wrong with it. */
  open(url: Source, files: Omit<AvatarFiles, "url"> = {}): Promise<Summary> {
    const opening = this.load(url, files);
    this.opening = opening.catch(() => {});
    return opening;
  }

  private async load(url: Source, { lips = null, sound = null }: AvatarFiles): Promise<Summary> {
    const player = this.alive(await this.started()), { signal } = this.disposing, { autoplay = true, gestures = true } = this.options;
    const data = await bytesOf(url, signal), [ofLips, ofSound] = await Promise.all([lips, sound].map((one) => one && bytesOf(one, signal)));
    this.hush();
    this.dialogue?.close();
    const summary = await player.open(data), { expressionNames, jointNames } = summary, jaw = jointNames.indexOf("jaw");
    this.alive(this.player);
    player.lips?.dispose();
    player.clock?.at(false, 0, 1);
    void this.sound?.context?.close();
    this.sound = ofSound ? new Soundtrack(ofSound, (message) => this.emit("error", new AvatarError("sound", message))) : null;
    player.clock = this.sound;
    player.playing = autoplay && !this.sound;
    player.perform(null, 0);
    this.standing = null;
    let deaf = "", hearing: LiveLips | null = null;
    try {
      hearing = ofLips ? new LiveLips(ofLips, expressionNames.length, jointNames) : null;
      this.standing = hearing && gestures ? Standing.of(hearing.network, jointNames, expressionNames.length) : null;
    } catch (error) {
      deaf = (error as Error).message;
    }
    player.lips = this.voice.lips = hearing;
    this.voice.face = hearing?.face ?? SpeakingFace.named(expressionNames, jaw);
    player.voice = this.voice;
    this.voice.hands = this.standing;
    this.summary = summary;
    if (!this.sound && (!player.playing || !player.duration)) this.act(0);
    this.emit("ready", summary);
    if (deaf) this.emit("error", new AvatarError("lips", deaf));
    return summary;
  }

  /**
   * Plays a motion from its beginning, or goes on with that which is there.
   *
   * @throws Error a motion of another skeleton.
   */
  async play(motion: MotionParams | null = null, { loop, speed, fade = 0.3 }: PlayOptions = {}): Promise<void> {
    // Sounds begin within the click that asks for them.
    this.sound?.unlock();
    const player = await this.opened();
    if (player !== this.player || !player) return;
    const played = motion && motionOf(motion, this.summary!);
    if (player.performer === this.standing) player.perform(null, fade);
    if (played) {
      player.clock?.at(false, 0, 1);
      player.clock = null;
      player.begin(played, fade);
    }
    if (loop !== undefined) player.loop = loop;
    if (speed !== undefined) player.speed = speed;
    player.playing = true;
    player.update();
  }

  /** Stops the motion where it is. */
  pause(): void {
    if (!this.player) return;
    this.player.playing = false;
    this.player.update();
  }

  /** Stands, breathes and looks about in the motion's place, and moves its hands with what it says. @throws Error it cannot. */
  async stand(): Promise<void> {
    const player = await this.opened();
    if (player !== this.player || !player) return;
    if (!this.standing) throw new Error("this avatar does not stand by itself; give createAvatar `lips`: the lips.safetensors that smplxpp web writes beside the avatar");
    player.playing = false;
    this.act(STANDS);
  }

  /** Stands where it is, unless somebody acts for it. */
  private act(fade: number): void {
    const player = this.player!;
    if (!this.standing || player.performer) return;
    this.standing.standAt(player.pose(player.time).translation);
    player.perform(this.standing, fade);
  }

  /** Holds joints, expressions and the place of the body, whatever the motion does; null lets go of all. @throws Error no such joint or expression. */
  async pose(params: PoseParams | null): Promise<void> {
    const player = await this.opened();
    if (player !== this.player || !player) return;
    const { jointNames, expressionNames } = this.summary!;
    const joints = named(params?.joints, jointNames, "joint", vector), expression = named(params?.expression, expressionNames, "expression", number);
    const place = params?.translation && vector(params.translation, "translation");
    player.held.clear();
    player.expressions.clear();
    joints.forEach(([joint, turn]) => player.held.set(joint, turn));
    expression.forEach(([k, value]) => player.expressions.set(k, value));
    player.place = place ?? null;
    player.update();
  }

  /**
   * Says a text, a sound, or visemes; what is being said ends. Call it within a click or a key: browsers play no sound before.
   *
   * @returns when it is over: false if it was ended before. @throws Error why it cannot be said.
   */
  async say(what: string | Utterance | readonly Viseme[] | Exclude<Source, string> | AudioBuffer | MediaStream): Promise<boolean> {
    const said = isSound(what) ? { audio: what } : Array.isArray(what) ? { visemes: what as readonly Viseme[] } : what as string | Utterance;
    const turn = ++this.turn;
    this.voice.hush();
    const speech = this.utter(said, turn, this.speech);
    this.speech = speech.catch(() => {});
    return speech;
  }

  /** Says it once what was said before has ended, unless something else is to be said by then. */
  private async utter(said: string | Utterance, turn: number, before: Promise<unknown>): Promise<boolean> {
    await before;
    await this.opened();
    if (!this.player || turn !== this.turn) return false;
    if (!this.player.playing) this.act(STANDS);
    let complete = false, began = false;
    try {
      return (complete = await this.voice.say(said, () => {
        began = true;
        this.emit("saying", said);
      }));
    } finally {
      if (began) this.emit("said", { what: said, complete });
      this.player?.update();
    }
  }

  /**
   * Talks with a server of `smplxpp chat`, whose voice, face and gestures the avatar has until the dialogue is closed.
   *
   * @param server the address of its page, which has to be of the same site as this one.
   * @returns before the server answers: `on("hello")` tells. @throws Error no such server, one that asks for a token, or another conversation was asked for meanwhile.
   */
  async converse(server: string | URL): Promise<Dialogue> {
    const player = this.alive(await this.opened()), { signal } = this.disposing, page = new URL(server, document.baseURI);
    const mine = ++this.asked, socket = await socketOf(page, signal);
    this.alive(this.player);
    if (mine !== this.asked) throw new Error(`${page}: another conversation was asked for`);
    this.hush();
    this.dialogue?.close();
    this.dialogue = new Dialogue(player, socket, page);
    this.dialogue.connect();
    return this.dialogue;
  }

  /** Silence at once. */
  hush(): void {
    ++this.turn;
    this.voice.hush();
    this.player?.lips?.stop();
  }

  /** Changes how the avatar is shown. @throws Error no such part, or a light that cannot be read. */
  async set(settings: AvatarSettings): Promise<void> {
    const { environment, environmentTurn, parts, simulate } = settings;
    const player = parts ? await this.opened() : await this.started();
    if (player !== this.player || !player) return;
    for (const [part, shown] of named(parts, this.summary?.partNames ?? [], "part", (value) => Boolean(value))) {
      if (shown) player.hidden.delete(part);
      else player.hidden.add(part);
    }
    if (simulate !== undefined) player.simulating = simulate;
    if (environmentTurn !== undefined) player.lightTurn = (environmentTurn * Math.PI) / 180;
    if (environment !== undefined) {
      const data = environment ? new Uint8Array(await bytesOf(environment, this.disposing.signal)) : null;
      player.light = data && { name: "environment", light: harmonicsOf(readRadiance(data)), captured: WHITE };
    }
    player.update();
  }

  /** Calls a function at an event; what is returned ends that. */
  on<K extends keyof AvatarEvents>(event: K, listener: (detail: AvatarEvents[K]) => void): () => void {
    const listeners = this.listeners.get(event) ?? new Set();
    this.listeners.set(event, listeners.add(listener));
    return () => void listeners.delete(listener);
  }

  /** Gives back worker, GPU, microphone and loudspeakers; nothing is done any more. */
  dispose(): void {
    this.disposing.abort(new Error("the avatar is disposed of"));
    this.voice.dispose();
    this.dialogue?.close();
    this.player?.clock?.at(false, 0, 1);
    void this.sound?.context?.close();
    this.player?.dispose();
    this.player = this.summary = this.sound = this.dialogue = this.standing = null;
    this.listeners.clear();
  }

  protected emit<K extends keyof AvatarEvents>(event: K, detail: AvatarEvents[K]): void {
    this.listeners.get(event)?.forEach((listener) => (listener as (detail: AvatarEvents[K]) => void)(detail));
  }

  /** What animates it, once that is there; null: the avatar is disposed of, and what was asked of it is nobody's any more. */
  protected async started(): Promise<P | null> {
    await this.unlessDisposed(this.beginning);
    return this.player;
  }

  /** The same once the file is open. @throws Error none is. */
  protected async opened(): Promise<P | null> {
    if (!this.summary) await this.unlessDisposed(this.ready.then(() => this.opening));
    if (this.player && !this.summary) throw new Error("no avatar is open: give createAvatar `url`, or call open");
    return this.player;
  }

  private async unlessDisposed(work: Promise<unknown>): Promise<void> {
    await work.catch((error) => {
      if (!this.disposing.signal.aborted) throw error;
    });
  }

  protected alive<T>(player: T | null): T {
    this.disposing.signal.throwIfAborted();
    return player!;
  }

  private beginning: Promise<void> = Promise.resolve();
  private opening: Promise<unknown> = Promise.resolve();
  /** Settled when what is said is over; counts what was to be said. */
  private speech: Promise<unknown> = Promise.resolve();
  private turn = 0;

  private async start(make: (options: AvatarOptions) => Promise<P> | P): Promise<void> {
    const { url, environment, environmentTurn, parts, simulate, ...options } = this.options;
    this.beginning = (async () => {
      const player = await make(options);
      // Disposed of in the meantime, as pages do that are built twice.
      if (this.disposing.signal.aborted) player.dispose();
      this.player = this.alive(player);
      player.onpicture = () => this.emit("picture", { pictures: player.pictures, time: player.time });
      player.onend = () => this.emit("end", null);
      player.onerror = (message) => this.emit("error", new AvatarError("avatar", message));
    })();
    await this.beginning;
    if (url !== undefined) await this.open(url, this.options);
    await Avatar.prototype.set.call(this, { environment, environmentTurn, ...(this.summary ? { parts, simulate } : {}) });
  }
}

function isSound(what: unknown): what is Exclude<Source, string> | AudioBuffer | MediaStream {
  return [URL, Blob, ArrayBuffer, AudioBuffer, MediaStream].some((kind) => what instanceof kind);
}

/** Values by name, or all in their order, as pairs of a place in `names` and a value. */
function named<V, T>(
  given: Readonly<Record<string, V>> | readonly V[] | undefined, names: readonly string[], kind: string, read: (value: V, subject: string) => T,
): [number, T][] {
  if (!given) return [];
  if (Array.isArray(given)) {
    if (given.length > names.length) throw new Error(`${kind}s: expected ${names.length} at most, received ${given.length}`);
    return given.map((value: V, k) => [k, read(value, `${kind} ${names[k]}`)]);
  }
  return Object.entries(given as Record<string, V>).map(([name, value]) => {
    const k = names.indexOf(name);
    if (k < 0) throw new Error(`${kind}: expected one of ${names.join(", ") || "none: this avatar has no such"}, received "${name}"`);
    return [k, read(value, `${kind} ${name}`)];
  });
}

function number(value: number, subject: string): number {
  if (!Number.isFinite(value)) throw new Error(`${subject}: expected a number, received ${String(value)}`);
  return value;
}

function vector(value: Vector, subject: string): Vector {
  if (value?.length !== 3) throw new Error(`${subject}: expected three numbers, received ${JSON.stringify(value)}`);
  return [number(value[0], subject), number(value[1], subject), number(value[2], subject)];
}

/** @throws Error frames that do not fit the avatar. */
function motionOf({ framesPerSecond, rotations, translation, expression }: MotionParams, { jointNames, expressionNames }: Summary): Motion {
  const frames = rotations.length, wrong = (what: string) => new Error(`motion: expected ${what}`);
  if (!frames) throw wrong("at least one frame, received none");
  if (!(framesPerSecond > 0 && framesPerSecond < Infinity)) throw wrong(`frames a second, received ${String(framesPerSecond)}`);
  const rows = <T>(given: readonly (readonly T[])[] | undefined, width: number, most: number, kind: string, read: (value: T, subject: string) => readonly number[]) => {
    if (given && given.length !== frames) throw wrong(`${frames} frames of ${kind}, received ${given.length}`);
    const out = new Float32Array(frames * width);
    given?.forEach((row, frame) => {
      if (row.length > most) throw wrong(`${most} ${kind} at most, received ${row.length} in frame ${frame}`);
      out.set(row.flatMap((value) => read(value, `motion: ${kind} of frame ${frame}`)), frame * width);
    });
    return out;
  };
  return {
    framesPerSecond, frames,
    rotations: rows(rotations, 3 * jointNames.length, jointNames.length, "rotations", vector),
    translation: rows(translation, 3, 3, "translations", (value, subject) => [number(value, subject)]),
    expression: rows(expression, expressionNames.length, expressionNames.length, "expressions", (value, subject) => [number(value, subject)]),
  };
}
