/** A conversation with a server of `smplxpp chat`, without any page around it: the avatar is the server's, as it speaks. */

import type { Animator } from "../animator.ts";
import { Connection, type Told } from "./connection.ts";
import { Microphone } from "./microphone.ts";
import { Stage } from "./stage.ts";
import { readFrames } from "./wire.ts";

/** What `on` tells; what else the server says comes under its own kind. */
export interface DialogueEvents {
  /** The connection is there, and the server's first pose. */
  open: null;
  shown: null;
  /** It is gone; for good where another page has taken over, else it is tried again. */
  lost: { final: boolean };
  /** Who answers, and whether speech is understood. */
  hello: { partner: string; hears: boolean };
  /** Somebody is heard to speak; what was typed or understood, "" for nothing. */
  listening: object;
  heard: { turn: number; text: string };
  /** A part of the answer begins to be heard, or cannot be spoken; the answer is over. */
  answer: { turn: number; text: string };
  answered: object;
  /** What the person should know. */
  note: { text: string };
  stopped: object;
  latency: { parts: Record<string, number> };
}

export class Dialogue {
  readonly stage: Stage;
  readonly microphone = new Microphone();
  readonly connection: Connection;
  private readonly listeners = new Map<string, Set<(detail: never) => void>>();
  /** The turn whose first picture is waited for, and how many there had been when it began to be heard. */
  private awaited: { turn: number; pictures: number } | null = null;
  /** The last turn that is known, and the last one that was stopped: sentences of it may still be on their way. */
  private turn = 0;
  private stopped = 0;
  /** What was typed before the first connection; null after it. */
  private early: string[] | null = [];

  /** @param socket its address. @param page that of the server, which is asked for the socket when that is lost. */
  constructor(private readonly player: Animator, socket: URL, page: URL) {
    const { jointNames, expressionNames } = player.summary!;
    this.stage = new Stage(jointNames.length, expressionNames.length);
    this.connection = new Connection(socket, page);
    player.performer = this.stage;
    this.stage.onbegin = ({ turn, text }) => {
      this.emit("answer", { turn, text });
      this.connection.send({ kind: "began", turn, what: "sound" });
      this.awaited = { turn, pictures: player.pictures };
    };
    const before = player.onpicture;
    player.onpicture = () => {
      before();
      // The picture that was under way when the line began shows the time before.
      if (this.awaited && player.pictures > this.awaited.pictures + 1) {
        this.connection.send({ kind: "began", turn: this.awaited.turn, what: "picture" });
        this.awaited = null;
      }
    };
    this.connection.onframes = (data) => {
      const frames = readFrames(data), known = this.stage.shown, { line } = frames;
      if (line) this.turn = Math.max(this.turn, line.turn);
      this.stage.take(line && line.turn <= this.stopped ? { ...frames, line: null } : frames);
      if (known) return;
      this.stage.pose();
      this.emit("shown", null);
    };
    this.connection.ontold = (told) => this.hear(told);
    this.connection.onopen = () => {
      this.stage.reset();
      this.turn = this.stopped = 0;
      for (const text of this.early ?? []) this.connection.send({ kind: "say", text });
      this.early = null;
      this.emit("open", null);
    };
    this.connection.onlost = (final) => {
      this.stage.hush();
      this.emit("lost", { final });
    };
  }

  /** Begins; once somebody listens to what it tells. */
  connect(): void {
    this.connection.connect();
  }

  on<K extends keyof DialogueEvents>(event: K, listener: (detail: DialogueEvents[K]) => void): () => void {
    const listeners = this.listeners.get(event) ?? new Set();
    this.listeners.set(event, listeners.add(listener));
    return () => void listeners.delete(listener);
  }

  /**
   * Says something to the avatar; what that says ends. To be called by a click or a key. Before the first connection it waits
   * for that. @returns whether somebody is there, or may come.
   */
  type(text: string): boolean {
    this.stage.unlock();
    this.stop();
    if (this.early) {
      this.early = [text];
      return true;
    }
    return this.connection.send({ kind: "say", text });
  }

  /** Ends what the avatar says. */
  stop(): void {
    this.stopped = this.turn;
    this.stage.hush();
    this.connection.send({ kind: "stop" });
  }

  /** Listens to the microphone. To be called by a click. @throws Error why it cannot. */
  async listen(): Promise<void> {
    this.stage.unlock();
    try {
      await this.microphone.start((samples) => this.connection.send(samples));
    } catch (error) {
      this.microphone.stop();
      throw error;
    }
  }

  mute(): void {
    this.microphone.stop();
    this.connection.send({ kind: "mute" });
  }

  /** Ends it: the avatar does what it did before. */
  close(): void {
    this.stage.hush();
    this.microphone.stop();
    this.connection.close();
    // It may be closed already, by the avatar that is disposed of after its conversation.
    if (this.stage.context?.state !== "closed") void this.stage.context?.close();
    this.listeners.clear();
    this.awaited = null;
    if (this.player.performer === this.stage) this.player.performer = null;
    this.player.update();
  }

  private hear(told: Told): void {
    if (told.kind === "listening" || told.kind === "stopped") this.stage.hush();
    if (told.kind === "heard" && typeof told.turn === "number") this.turn = told.turn;
    // What cannot be spoken is shown.
    this.emit((told.kind === "silent" ? "answer" : told.kind) as keyof DialogueEvents, told as never);
  }

  private emit<K extends keyof DialogueEvents>(event: K, detail: DialogueEvents[K]): void {
    this.listeners.get(event)?.forEach((listener) => (listener as (detail: DialogueEvents[K]) => void)(detail));
  }
}
