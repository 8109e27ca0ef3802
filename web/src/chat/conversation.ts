/** The page's side of a conversation: what is typed or said goes to the server, what comes back is shown and heard. */

import type { Pose } from "../avatar/avatar.ts";
import type { Player } from "../player.ts";
import { element, iconButton, ICONS } from "../ui/elements.ts";
import { Connection, type Told } from "./connection.ts";
import { Microphone } from "./microphone.ts";
import { Stage } from "./stage.ts";
import { readFrames } from "./wire.ts";

/** As the server has it. */
const MOST_TYPED = 2000;
/** Things said that are kept on the page. */
const SHOWN = 40;
const NAMES: Record<string, string> = {
  pause: "pause", recognised: "words", "first words": "answer", sentence: "sentence", voice: "voice", sent: "sent",
  heard: "sound", seen: "picture",
};

export class Conversation {
  readonly stage: Stage;
  readonly microphone = new Microphone();
  private readonly connection: Connection;
  private readonly log = element("div", { class: "said", role: "log", "aria-label": "Conversation" });
  private readonly note = element("div", { class: "note", role: "status" });
  private readonly times = element("div", { class: "times" });
  private readonly thinking = element("div", { class: "thinking", role: "img", "aria-label": "An answer is being made" }, element("i"), element("i"), element("i"));
  private readonly input = element("input", { type: "text", maxlength: MOST_TYPED, placeholder: "Say something", "aria-label": "Say something", autocomplete: "off" });
  private readonly speak = iconButton("Speak", "microphone", ICONS.microphone);
  private turn = 0;
  private answer: HTMLElement | null = null;
  /** The turn whose first picture is waited for, and how many there had been when it began to be heard. */
  private awaited: { turn: number; pictures: number } | null = null;

  constructor(private readonly player: Player, secret: string) {
    const { jointNames, expressionNames } = player.summary!;
    this.stage = new Stage(jointNames.length, expressionNames.length);
    this.connection = new Connection(secret);
    player.performer = this.stage;
    this.speak.type = "button"; // else Enter in the text would press it
    document.body.classList.add("chatting");
    const bar = element("form", { class: "talk" }, this.input, this.speak);
    document.body.append(element("section", { class: "chat", "aria-label": "Conversation" }, this.log, this.note, bar, this.times));
    bar.addEventListener("submit", (event) => {
      event.preventDefault();
      this.type();
    });
    this.input.addEventListener("input", () => this.stage.speaking && this.stop());
    this.speak.addEventListener("click", () => void this.listen());
    this.stage.onbegin = (line) => {
      this.show(line);
      this.connection.send({ kind: "began", turn: line.turn, what: "sound" });
      this.awaited = { turn: line.turn, pictures: player.pictures };
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
      const frames = readFrames(data), known = this.stage.shown;
      this.stage.take(frames);
      if (!known) this.look(this.stage.pose());
    };
    this.connection.ontold = (told) => this.hear(told);
    this.connection.onopen = () => {
      this.stage.reset();
      this.say("");
    };
    this.connection.onlost = (final) => {
      this.thinking.remove();
      this.stage.hush();
      this.say(final ? "Another page has taken over. Reload this one to talk here." : "The connection is lost; it is tried again. If the server was started anew, reload the page.");
    };
    this.connection.connect();
  }

  /** Sends what is typed; what is being said ends. */
  private type(): void {
    const text = this.input.value.trim();
    if (!text) return;
    this.stage.unlock();
    this.stop();
    if (!this.connection.send({ kind: "say", text })) {
      this.say("Nobody is there to hear it yet.");
      return;
    }
    this.input.value = "";
    this.say("");
  }

  private stop(): void {
    this.stage.hush();
    this.connection.send({ kind: "stop" });
  }

  private async listen(): Promise<void> {
    this.stage.unlock();
    const { microphone } = this;
    if (microphone.on) {
      microphone.stop();
      this.connection.send({ kind: "mute" });
      this.say("");
    } else {
      try {
        await microphone.start((samples) => this.connection.send(samples));
        this.say("Listening");
      } catch (error) {
        microphone.stop();
        this.say(`The microphone cannot be used: ${(error as Error).message}`);
      }
    }
    this.speak.classList.toggle("on", microphone.on);
    this.speak.title = microphone.on ? "Stop listening" : "Speak";
  }

  private hear(told: Told): void {
    const text = String(told.text ?? "");
    if (["answered", "stopped", "note", "hello", "listening"].includes(told.kind)) this.thinking.remove();
    if (told.kind === "hello") {
      this.speak.hidden = !told.hears;
      this.times.textContent = `Answers: ${told.partner}`;
    } else if (told.kind === "listening") {
      this.stage.hush();
      this.say("I hear you");
    } else if (told.kind === "heard") {
      this.say(this.microphone.on ? "Listening" : "");
      if (!text) return;
      this.turn = Number(told.turn);
      this.answer = null;
      this.add("mine", text);
      this.log.append(this.thinking);
    } else if (told.kind === "stopped") {
      this.stage.hush();
    } else if (told.kind === "silent") {
      this.show({ turn: Number(told.turn), text });
    } else if (told.kind === "latency") {
      const parts = Object.entries(told.parts as Record<string, number>).map(([part, seconds]) => `${NAMES[part] ?? part} ${seconds.toFixed(2)}`);
      this.times.textContent = `${parts.join(" · ")} s`;
    } else if (told.kind === "note") {
      this.say(text);
    }
  }

  /** Shows words of the answer as they are heard. */
  private show({ turn, text }: { turn: number; text: string }): void {
    if (turn !== this.turn) return;
    this.thinking.remove();
    this.answer ??= this.add("theirs", "");
    this.answer.textContent += `${this.answer.textContent ? " " : ""}${text}`;
    this.log.scrollTop = this.log.scrollHeight;
  }

  private add(who: string, text: string): HTMLElement {
    const said = element("p", { class: who }, text);
    this.log.append(said);
    while (this.log.childElementCount > SHOWN) this.log.firstElementChild!.remove();
    this.log.scrollTop = this.log.scrollHeight;
    return said;
  }

  private say(text: string): void {
    this.note.textContent = text;
  }

  /** Shows head, chest and hands of who stands there. */
  private look(pose: Pose | null): void {
    this.player.lookAtChest(pose?.translation);
  }
}
