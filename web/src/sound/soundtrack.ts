/** Sound that goes with a motion: its clock leads, so that both stay together at any rate of pictures. */

import type { Clock } from "../animator.ts";
import { Playing } from "./playing.ts";

/** Seconds ahead of the present at which a sound is begun: what is asked for at once may begin late. */
const AHEAD = 0.05;
/** Seconds in which the sound has to begin after a click: who has no way to hear it watches without. */
const PATIENCE = 4;

/** One sound from the motion's first frame on. Browsers play nothing before a click. */
export class Soundtrack implements Clock {
  /** Of the sound, seconds; 0 until it is decoded. */
  seconds = 0;
  context: AudioContext | null = null;
  /** What everything that is heard passes, for who wants to look at it. */
  output: GainNode | null = null;
  private buffer: AudioBuffer | null = null;
  private source: Playing | null = null;
  private speed = 1;
  /** What was answered last: another time than that is one that somebody chose. */
  private last = NaN;
  private failed = false;
  private asked = 0;

  /** @param data a file that browsers decode; it is taken. @param tell says why there is no sound. */
  constructor(private readonly data: ArrayBuffer, private readonly tell: (message: string) => void) {}

  /** Makes it ready; to be called by a click or a key. */
  unlock(): void {
    if (this.failed) return;
    if (this.context) {
      if (this.context.state !== "running") void this.context.resume().catch(() => {}); // closed before it is awake
      return;
    }
    this.asked = performance.now();
    try {
      this.context = new AudioContext();
      this.output = this.context.createGain();
      this.output.connect(this.context.destination);
      void this.context.resume().catch(() => {}); // closed before it is awake
    } catch (error) {
      this.fail(`this browser plays no sound (${(error as Error).message})`);
      return;
    }
    this.context.decodeAudioData(this.data).then((buffer) => {
      this.buffer = buffer;
      this.seconds = buffer.duration;
    }, () => this.fail("the sound of this page is damaged, or no kind that this browser plays"));
  }

  at(playing: boolean, time: number, speed: number): number | null {
    if (this.failed) return null;
    const { context, buffer } = this;
    if (!playing) {
      this.silence();
      return (this.last = time);
    }
    if (!context || !buffer || context.state !== "running") {
      if (context && performance.now() - this.asked > 1000 * PATIENCE) {
        this.fail("nothing here plays the sound: it goes on without");
        return null;
      }
      return time;
    }
    if (!this.source || time !== this.last || speed !== this.speed) this.begin(context, buffer, time, speed);
    return (this.last = Math.max(time, this.source!.heard()));
  }

  private begin(context: AudioContext, buffer: AudioBuffer, time: number, speed: number): void {
    this.silence();
    this.speed = speed;
    this.source = Playing.of(context, buffer, this.output!, speed);
    this.source.start(context.currentTime + AHEAD, time);
  }

  private silence(): void {
    this.source?.stop();
    this.source = null;
  }

  private fail(message: string): void {
    this.failed = true;
    this.silence();
    this.tell(message);
  }
}
