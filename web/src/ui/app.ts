/** The page around the player. */

import type { CanvasAvatar } from "../embed/canvas.ts";
import type { Source } from "../embed/source.ts";
import type { Player } from "../player.ts";
import { element, iconButton, ICONS, paintShare, setIcon } from "./elements.ts";
import { enterStereo, offersStereo } from "../xr/stereo.ts";
import { isRadiance } from "../light/radiance.ts";
import { listen } from "./gestures.ts";
import { lightOf, shine } from "./light.ts";
import { makePanel } from "./panel.ts";

const SPEEDS = [1, 0.5, 0.25, 2];
/** Milliseconds between changes of the numbers on the page. */
const RATES_EVERY = 400;

/** CSS pixels at the bottom that the controls cover, and those that the button above them does. */
const COVERED = 64, SPEAK = 52;
const TITLES = { avatar: "This avatar cannot be shown", sound: "There is no sound", lips: "The mouth cannot follow live sound" };

export class App {
  private readonly title = element("header", { class: "title" });
  private readonly rates = element("div", { class: "rates" });
  private readonly welcome = element("div", { class: "welcome" });
  private readonly playButton = iconButton("Pause", "play", ICONS.pause);
  private readonly scrub = element("input", { type: "range", min: 0, max: 1, step: 0.001, "aria-label": "Time" });
  private readonly clock = element("span", { class: "time" });
  private readonly speed = element("button", { class: "speed", title: "Speed", "aria-label": "Speed 1×" }, "1×");
  private readonly menu = iconButton("Settings", "menu", ICONS.settings);
  private readonly stereo = iconButton("View in the headset", "stereo", ICONS.stereo);
  private readonly bar: HTMLElement;
  private readonly speak = element("button", { class: "button speak", hidden: true }, "Play with sound");
  private panel: HTMLElement | null = null;
  private lastRates = 0;

  private readonly player: Player;
  private readonly stage: HTMLCanvasElement;

  constructor(private readonly avatar: CanvasAvatar) {
    const stage = (this.stage = avatar.canvas), player = (this.player = avatar.player!);
    player.covered = COVERED;
    this.bar = element("div", { class: "bar" }, this.playButton, this.scrub, this.clock, this.speed);
    stage.after(this.title, this.menu, this.stereo, this.rates, this.bar, this.speak, this.welcome);
    this.menu.setAttribute("aria-controls", "settings");
    this.showControls(false);
    listen(stage, player, document.body);
    this.listenToControls();
    this.listenToFiles();
    avatar.on("ready", () => this.begin());
    avatar.on("picture", () => this.refresh());
    avatar.on("error", ({ about, message }) => this.fail(message, TITLES[about]));
  }

  /** Opens an avatar, the sound of its motion and its lips, and shows it; what is wrong is said on the page. */
  async open(data: Source, more: { sound?: Source | null; lips?: Source | null } = {}): Promise<void> {
    this.say("Opening the avatar").prepend(element("div", { class: "spinner" }));
    await this.avatar.open(data, more).catch((error: Error) => this.fail(error.message));
  }

  /** Shows the controls of what was opened. */
  private begin(): void {
    const { name } = this.avatar.summary!;
    this.welcome.replaceChildren();
    this.offerSound(Boolean(this.player.clock));
    this.player.resetView();
    document.title = name;
    this.stage.ariaLabel = `${name}, an avatar. Arrow keys turn it, plus and minus come nearer and go away, Home goes back.`;
    this.title.replaceChildren(element("h1", {}, name), element("p", {}, "SMPLX++ avatar"));
    this.panel?.remove();
    this.panel = makePanel(this.player, (message, title) => this.fail(message, title));
    this.title.after(this.panel);
    this.openPanel(false);
    this.showControls(true);
    this.bar.hidden = !this.player.duration;
  }

  /** Says what went wrong, and offers another file. */
  fail(message: string, title = "This avatar cannot be shown"): void {
    const said = message.charAt(0).toUpperCase() + message.slice(1);
    const buttons = this.chooser("Open another file");
    const card = this.say(title, element("p", {}, `${said}.`), buttons);
    card.classList.add("failed");
    card.setAttribute("role", "alert");
    if (!this.player.summary) return;
    const back = element("button", { class: "button back" }, "Back");
    back.addEventListener("click", () => this.closeCard());
    buttons.prepend(back);
    back.focus();
  }

  /** Asks for a file. */
  invite(): void {
    this.say("Open an avatar", element("p", {}, "Drop a .avatar file here, or choose one."), this.chooser("Choose a file"));
  }

  /** Shows a card, whose title is the page's as long as there is no other. */
  private say(title: string, ...content: Node[]): HTMLElement {
    const heading = element(this.player.summary ? "h2" : "h1", {}, title);
    const card = element("div", { class: "card", role: "status" }, heading, ...content);
    this.welcome.replaceChildren(card);
    return card;
  }

  /** Shows the button that begins a motion with its sound, and keeps the person above it. */
  private offerSound(offered: boolean): void {
    this.speak.hidden = !offered;
    this.player.covered = offered ? COVERED + SPEAK : COVERED;
    this.player.update();
  }

  private closeCard(): void {
    this.welcome.replaceChildren();
    this.stage.focus();
  }

  private openPanel(open: boolean): void {
    if (!this.panel) return;
    this.panel.hidden = !open;
    setIcon(this.menu, open ? ICONS.close : ICONS.settings);
    this.menu.ariaExpanded = String(open);
  }

  private chooser(label: string): HTMLElement {
    const input = element("input", { type: "file", accept: ".avatar,.zip", hidden: true, "aria-label": label });
    input.addEventListener("change", () => input.files?.[0] && this.open(input.files[0]));
    const button = element("button", { class: "button" }, label);
    button.addEventListener("click", () => input.click());
    return element("div", {}, button, input);
  }

  private showControls(shown: boolean): void {
    for (const part of [this.bar, this.menu, this.rates]) part.hidden = !shown;
    this.stereo.hidden = true;
    if (shown) offersStereo().then((offered) => (this.stereo.hidden = !offered));
  }

  private listenToControls(): void {
    const { player } = this;
    const toggle = () => {
      if (player.playing) this.avatar.pause();
      else void this.avatar.play();
      this.offerSound(false);
      this.showPlaying();
    };
    this.speak.addEventListener("click", toggle);
    this.playButton.addEventListener("click", toggle);
    document.body.addEventListener("keydown", (event) => {
      if (event.key !== " " || event.target instanceof HTMLButtonElement || event.target instanceof HTMLInputElement) return;
      event.preventDefault();
      toggle();
    });
    this.stereo.addEventListener("click", () => {
      this.stereo.disabled = true;
      enterStereo(player).catch((error: Error) => this.fail(`the headset cannot be entered: ${error.message}`, "The headset stays dark"))
        .finally(() => (this.stereo.disabled = false));
    });
    this.scrub.addEventListener("input", () => {
      player.seek(Number(this.scrub.value) * player.duration);
    });
    this.speed.addEventListener("click", () => {
      player.speed = SPEEDS[(SPEEDS.indexOf(player.speed) + 1) % SPEEDS.length];
      this.speed.textContent = `${player.speed}×`;
      this.speed.ariaLabel = `Speed ${player.speed}×`;
    });
    this.menu.addEventListener("click", () => this.openPanel(Boolean(this.panel?.hidden)));
    document.body.addEventListener("keydown", (event) => {
      if (event.key !== "Escape") return;
      if (this.welcome.querySelector(".back")) this.closeCard();
      else if (this.panel && !this.panel.hidden) {
        this.openPanel(false);
        this.menu.focus();
      }
    });
  }

  private listenToFiles(): void {
    window.addEventListener("dragover", (event) => {
      event.preventDefault();
      document.body.classList.add("dropping");
    });
    window.addEventListener("dragleave", (event) => {
      if (!event.relatedTarget) document.body.classList.remove("dropping");
    });
    window.addEventListener("drop", (event) => {
      event.preventDefault();
      document.body.classList.remove("dropping");
      const file = event.dataTransfer?.files[0];
      if (file) this.take(file);
    });
  }

  private showPlaying(): void {
    const said = this.player.playing ? "Pause" : "Play";
    if (this.playButton.title === said) return;
    setIcon(this.playButton, this.player.playing ? ICONS.pause : ICONS.play);
    this.playButton.title = said;
    this.playButton.ariaLabel = said;
  }

  /** Opens a file that was dropped: an avatar, or a panorama as light. */
  private async take(file: File): Promise<void> {
    const data = await file.arrayBuffer();
    if (!isRadiance(new Uint8Array(data)) && !/\.(hdr|exr)$/i.test(file.name)) return this.open(data);
    try {
      shine(this.player, lightOf(data, file.name));
    } catch (error) {
      this.fail((error as Error).message, "This light cannot be shown");
    }
  }

  private refresh(): void {
    this.showPlaying();
    const { player } = this, whole = player.duration;
    if (whole) {
      this.scrub.value = String(player.time / whole);
      paintShare(this.scrub);
      this.clock.textContent = `${player.time.toFixed(1)} / ${whole.toFixed(1)} s`;
    }
    const now = performance.now();
    if (now - this.lastRates < RATES_EVERY) return;
    this.lastRates = now;
    const { fps, deform, cloth, sort, draw } = player.rates;
    const { count, lost } = player.threads, shared = lost ? " (1 thread, the others failed)" : count > 1 ? ` (${count} threads)` : "";
    const parts = [`pose ${deform.toFixed(1)}${shared}`];
    if (player.summary!.garments.length && player.simulating) parts.push(`cloth ${cloth.toFixed(1)}`);
    if (!player.renderer.sorts || player.renderer.sorting !== null) parts.push(`sort ${sort.toFixed(1)}`);
    if (draw !== null) parts.push(`draw ${draw.toFixed(1)}`);
    const size = `${(player.summary!.bytes / 1e6).toFixed(1)} MB`;
    this.rates.title = lost ?? "";
    this.rates.replaceChildren(element("b", {}, `${fps.toFixed(fps < 10 ? 1 : 0)} fps`),
      element("span", {}, ` · ${parts.join(" · ")} ms · ${player.renderer.name} · ${size}`));
  }
}
