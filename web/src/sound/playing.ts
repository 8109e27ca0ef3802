/** A sound that is played, and which of its samples the audio's own thread has come to. */

/** Seconds between two looks at the clock that count as one moment, because another thread may have the core between them. */
const MOMENT = 0.004;
/** How often it is looked at until they do. */
const LOOKS = 4;
/** Seconds by which a beginning is measured anew before that counts: twice what a browser renders at once. */
const SLACK = 0.01;
/** Seconds after which a sound that nothing shows of is taken to have begun when it was asked to. */
const PATIENCE = 1;
/** Samples that an analyser holds at least; the last one counts. */
const WINDOW = 32;

/**
 * A sound from its first sample on, or from a later one.
 *
 * A sound whose beginning has passed when the audio's thread comes to it begins late and stays late, which no property of its
 * node tells. So a channel that nobody hears goes along: its samples are their own places, and the last one that an analyser
 * holds is the place that was rendered last.
 */
export class Playing {
  onended: () => void = () => {};
  private readonly node: AudioBufferSourceNode;
  private readonly splitter: ChannelSplitterNode;
  private readonly analyser: AnalyserNode;
  private readonly silence: GainNode;
  private readonly window = new Float32Array(WINDOW);
  private readonly length: number;
  /** The context's time at which its first sample was due; null: it is not known to have begun. */
  private origin: number | null = null;
  private over = false;
  private when = 0;
  private from = 0;

  /** @param channels samples of the sound, as many in each. @param speed 1: as it was recorded. */
  constructor(
    private readonly context: AudioContext, channels: readonly Float32Array[], rate: number, output: AudioNode, private readonly speed = 1,
  ) {
    const length = Math.max(channels[0].length, 1), count = channels.length, buffer = context.createBuffer(count + 1, length, rate);
    channels.forEach((samples, c) => buffer.copyToChannel(samples as Float32Array<ArrayBuffer>, c));
    const places = buffer.getChannelData(count);
    for (let k = 0; k < length; ++k) places[k] = (k + 1) / length;
    this.length = length / rate;
    this.node = context.createBufferSource();
    this.node.buffer = buffer;
    this.node.playbackRate.value = speed;
    this.splitter = this.node.connect(context.createChannelSplitter(count + 1)) as ChannelSplitterNode;
    // One channel goes to all loudspeakers, several to those that they are for.
    const merger = count > 1 ? context.createChannelMerger(count) : output;
    for (let c = 0; c < count; ++c) this.splitter.connect(merger, c, count > 1 ? c : 0);
    if (merger !== output) merger.connect(output);
    this.analyser = context.createAnalyser();
    this.analyser.fftSize = WINDOW;
    this.splitter.connect(this.analyser, count);
    // A node that leads nowhere is not run everywhere.
    this.silence = context.createGain();
    this.silence.gain.value = 0;
    this.analyser.connect(this.silence).connect(context.destination);
    this.node.onended = () => {
      this.origin ??= this.when - this.from / speed;
      this.over = true;
      this.stop();
      this.onended();
    };
  }

  /** The same of a sound that was decoded. */
  static of(context: AudioContext, buffer: AudioBuffer, output: AudioNode, speed = 1): Playing {
    const channels = Array.from({ length: buffer.numberOfChannels }, (_, c) => buffer.getChannelData(c));
    return new Playing(context, channels, buffer.sampleRate, output, speed);
  }

  /** Begins at a time of the context's, at so many seconds of the sound. */
  start(when: number, from = 0): void {
    this.when = when;
    this.from = Math.min(from, this.length);
    this.node.start(when, this.from);
  }

  /** Ends it; `onended` is not called. */
  stop(): void {
    this.node.onended = null;
    this.node.stop();
    for (const one of [this.splitter, this.analyser, this.silence]) one.disconnect();
  }

  /** The context's time at which the sound's first sample was due, as it is truly played; null: it has not begun. */
  begun(): number | null {
    if (this.over) return this.origin;
    for (let k = 0; k < LOOKS; ++k) {
      const before = this.context.currentTime;
      this.analyser.getFloatTimeDomainData(this.window);
      const now = this.context.currentTime, place = this.window[WINDOW - 1] * this.length;
      if (now - before > MOMENT) continue;
      const origin = place > 0 ? now - place / this.speed : null;
      if (origin !== null && !(Math.abs(origin - (this.origin ?? Infinity)) < SLACK)) this.origin = origin;
      if (origin === null && now > this.when + PATIENCE) this.origin ??= this.when - this.from / this.speed;
      break;
    }
    return this.origin;
  }

  /** Seconds of the sound that the loudspeakers have come to. */
  heard(): number {
    const begun = this.begun(), { currentTime, outputLatency } = this.context;
    return begun === null ? this.from : Math.max(this.from, (currentTime - (outputLatency || 0) - begun) * this.speed);
  }
}
