/** The page's side of a conversation: what is typed or said goes to the server, what comes back is shown and heard. */

import type { Player } from "../player.ts";
import { element, iconButton, ICONS } from "../ui/elements.ts";
import type { Connection } from "./connection.ts";
import { Dialogue } from "./dialogue.ts";
import type { Microphone } from "./microphone.ts";
import type { Stage } from "./stage.ts";

/** As the server has it. */
const MOST_TYPED = 2000;
/** Things said that are kept on the page. */
const SHOWN = 40;
const NAMES: Record<string, string> = {
  pause: "pause", recognised: "words", "first words": "answer", sentence: "sentence", voice: "voice", sent: "sent",
  heard: "sound", seen: "picture",
};

export class Conversation {
  private readonly dialogue: Dialogue;
  private readonly log = element("div", { class: "said", role: "log", "aria-label": "Conversation" });
  private readonly note = element("div", { class: "note", role: "status" });
  private readonly times = element("div", { class: "times" });
  private readonly thinking = element("div", { class: "thinking", role: "img", "aria-label": "An answer is being made" }, element("i"), element("i"), element("i"));
  private readonly input = element("input", { type: "text", maxlength: MOST_TYPED, placeholder: "Say something", "aria-label": "Say something", autocomplete: "off" });
  private readonly speak = iconButton("Speak", "microphone", ICONS.microphone);
  private turn = 0;
  private answer: HTMLElement | null = null;

  constructor(player: Player, secret: string) {
    const dialogue = (this.dialogue = new Dialogue(player, new URL(secret, location.href), new URL(location.href)));
    this.speak.type = "button"; // else Enter in the text would press it
    document.body.classList.add("chatting");
    const bar = element("form", { class: "talk" }, this.input, this.speak);
    document.body.append(element("section", { class: "chat", "aria-label": "Conversation" }, this.log, this.note, bar, this.times));
    bar.addEventListener("submit", (event) => {
      event.preventDefault();
      this.type();
    });
    this.input.addEventListener("input", () => this.stage.speaking && dialogue.stop());
    this.speak.addEventListener("click", () => void this.listen());
    dialogue.on("answer", (answer) => this.show(answer));
    dialogue.on("shown", () => player.lookAtChest(this.stage.shown?.translation));
    dialogue.on("open", () => this.say(""));
    dialogue.on("lost", ({ final }) => {
      this.thinking.remove();
      this.say(final ? "Another page has taken over. Reload this one to talk here." : "The connection is lost; it is tried again.");
    });
    for (const event of ["answered", "stopped", "note", "hello", "listening"] as const) dialogue.on(event, () => this.thinking.remove());
    dialogue.on("hello", ({ partner, hears }) => {
      this.speak.hidden = !hears;
      this.times.textContent = `Answers: ${partner}`;
    });
    dialogue.on("listening", () => this.say("I hear you"));
    dialogue.on("heard", ({ turn, text }) => this.heard(turn, text));
    dialogue.on("note", ({ text }) => this.say(text));
    dialogue.on("latency", ({ parts }) => {
      this.times.textContent = `${Object.entries(parts).map(([part, seconds]) => `${NAMES[part] ?? part} ${seconds.toFixed(2)}`).join(" · ")} s`;
    });
    dialogue.connect();
  }

  get stage(): Stage {
    return this.dialogue.stage;
  }

  get connection(): Connection {
    return this.dialogue.connection;
  }

  get microphone(): Microphone {
    return this.dialogue.microphone;
  }

  /** Sends what is typed; what is being said ends. */
  private type(): void {
    const text = this.input.value.trim();
    if (!text) return;
    if (!this.dialogue.type(text)) {
      this.say("Nobody is there to hear it yet.");
      return;
    }
    this.input.value = "";
    this.say("");
  }

  private async listen(): Promise<void> {
    const { dialogue, microphone } = this;
    const before = microphone.on;
    if (before) dialogue.mute();
    const failed = before ? null : await dialogue.listen().then(() => null, (error: Error) => error);
    this.say(failed ? `The microphone cannot be used: ${failed.message}` : microphone.on ? "Listening" : "");
    this.speak.classList.toggle("on", microphone.on);
    this.speak.title = microphone.on ? "Stop listening" : "Speak";
  }

  private heard(turn: number, text: string): void {
    this.say(this.microphone.on ? "Listening" : "");
    if (!text) return;
    this.turn = turn;
    this.answer = null;
    this.add("mine", text);
    this.log.append(this.thinking);
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
}
