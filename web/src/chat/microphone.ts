/** The microphone as 16-bit samples at 16 kHz, in small pieces. */

import { Resampler } from "./resample.ts";

export const RATE = 16000;
/** The thread of the audio hands on what it gets; it runs beside the page. */
const WORKLET = `registerProcessor("tap", class extends AudioWorkletProcessor {
  process([[samples]]) { if (samples) this.port.postMessage(samples.slice()); return true; }
});`;

export class Microphone {
  /** @param piece samples that are handed on at once: 64 ms. */
  constructor(private readonly piece = 1024) {}

  private stream: MediaStream | null = null;
  private context: AudioContext | null = null;
  /** The stream is somebody else's, who stops it. */
  private lent = false;

  get on(): boolean {
    return this.stream !== null;
  }

  /** Begins to listen, to a stream in the place of the microphone where one is given. @throws Error why it cannot. */
  async start(hear: (samples: Int16Array) => void, stream: MediaStream | null = null): Promise<void> {
    this.lent = stream !== null;
    if (!stream && !navigator.mediaDevices?.getUserMedia) throw new Error("this browser gives pages no microphone");
    const wanted = { channelCount: 1, echoCancellation: true, noiseSuppression: true, autoGainControl: true };
    this.stream = stream ?? await navigator.mediaDevices.getUserMedia({ audio: wanted });
    this.context = new AudioContext();
    const url = URL.createObjectURL(new Blob([WORKLET], { type: "text/javascript" }));
    await this.context.audioWorklet.addModule(url);
    URL.revokeObjectURL(url);
    const tap = new AudioWorkletNode(this.context, "tap", { numberOfInputs: 1, numberOfOutputs: 1, channelCount: 1 });
    const resampler = new Resampler(this.context.sampleRate, RATE), left: number[] = [];
    tap.port.onmessage = ({ data }: MessageEvent<Float32Array>) => {
      left.push(...resampler.push(data));
      while (left.length >= this.piece) {
        hear(Int16Array.from(left.splice(0, this.piece), (value) => Math.round(32767 * Math.min(1, Math.max(-1, value)))));
      }
    };
    this.context.createMediaStreamSource(this.stream).connect(tap);
    // A node that leads nowhere is not run everywhere; it gives silence.
    tap.connect(this.context.destination);
    await this.context.resume();
  }

  stop(): void {
    if (!this.lent) this.stream?.getTracks().forEach((track) => track.stop());
    void this.context?.close();
    this.stream = this.context = null;
  }
}
