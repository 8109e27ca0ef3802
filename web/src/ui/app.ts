/** The page around the player. */

import { BundleError } from "../bundle/errors.ts";
import type { Player } from "../player.ts";
import { element, iconButton, ICONS, paintShare, setIcon } from "./elements.ts";
import { LiveLips } from "../lips/lips.ts";
import { Soundtrack } from "../sound/soundtrack.ts";
import { enterStereo, offersStereo } from "../xr/stereo.ts";
import { isRadiance } from "../light/radiance.ts";
import { listen } from "./gestures.ts";
import { lightOf, shine } from "./light.ts";
import { makePanel } from "./panel.ts";

const SPEEDS = [1, 0.5, 0.25, 2];
/** Milliseconds between changes of the numbers on the page. */
const RATES_EVERY = 400;

/** Bytes that are there or on their way. */
export type Data = Promise<ArrayBuffer> | ArrayBuffer;

export class App {
  private readonly title = element("header", { class: "title" });
  private readonly rates = element("div", { class: "rates" });
  private readonly welcome = element("div", { class: "welcome" });
  private readonly playButton = iconButton("Pause", "play", ICONS.pause);
  private readonly scrub = element("input", { type: "range", min: 0, max: 1, step: 0.001, "aria-label": "Time" });
  private readonly clock = element("span", { class: "time" });
  private readonly speed = element("button", { class: "speed", title: "Speed" }, "1×");
  private readonly menu = iconButton("Settings", "menu", ICONS.settings);
  private readonly stereo = iconButton("View in the headset", "stereo", ICONS.stereo);
  private readonly bar: HTMLElement;
  private readonly speak = element("button", { class: "button speak", hidden: true }, "Play with sound");
  private panel: HTMLElement | null = null;
  private soundtrack: Soundtrack | null = null;
  private lastRates = 0;

  constructor(private readonly player: Player, stage: HTMLCanvasElement) {
    this.bar = element("div", { class: "bar" }, this.playButton, this.scrub, this.clock, this.speed);
    document.body.append(this.title, this.menu, this.stereo, this.rates, this.bar, this.speak, this.welcome);
    this.showControls(false);
    listen(stage, player);
    this.listenToControls();
    this.listenToFiles();
    new ResizeObserver(() => player.update()).observe(stage);
    player.onpicture = () => this.refresh();
    player.onerror = (message) => this.fail(message);
  }

  /** Opens a bundle's bytes, the sound of its motion and its lips, and shows it; what is wrong is said on the page. */
  async open(data: Data, { sound = null, lips = null }: { sound?: Data | null; lips?: Data | null } = {}): Promise<void> {
    this.say(element("div", { class: "spinner" }), element("h2", {}, "Opening the avatar"));
    try {
      const about = await this.player.open(await data);
      this.welcome.replaceChildren();
      await this.takeSound(sound);
      this.player.lips?.stop();
      this.player.lips = lips && this.speaking(await lips);
      document.title = about.name;
      this.title.replaceChildren(element("h1", {}, about.name), element("p", {}, "SMPLX++ avatar"));
      this.panel?.remove();
      this.panel = makePanel(this.player, (message, title) => this.fail(message, title));
      this.title.after(this.panel);
      setIcon(this.menu, ICONS.settings);
      this.showControls(true);
      this.bar.hidden = !this.player.duration;
    } catch (error) {
      this.fail(error instanceof BundleError || error instanceof Error ? error.message : String(error));
    }
  }

  /** Plays the motion with this sound from now on; without one, by itself. */
  private async takeSound(data: Data | null): Promise<void> {
    const { player } = this;
    player.clock?.at(false, 0, 1);
    this.soundtrack = data && new Soundtrack(await data, (message) => this.fail(message, "There is no sound"));
    player.clock = this.soundtrack;
    player.playing = !this.soundtrack;
    this.speak.hidden = !this.soundtrack;
  }

  /** What moves the mouth by live sound; null: it cannot, which is said. */
  private speaking(data: ArrayBuffer): LiveLips | null {
    const { expressionNames, jointNames } = this.player.summary!;
    try {
      return new LiveLips(data, expressionNames.length, jointNames);
    } catch (error) {
      this.fail((error as Error).message, "The mouth cannot follow live sound");
      return null;
    }
  }

  /** Says what went wrong, and offers another file. */
  fail(message: string, title = "This avatar cannot be shown"): void {
    const said = message.charAt(0).toUpperCase() + message.slice(1);
    const buttons = this.chooser("Open another file");
    if (this.player.summary) {
      const back = element("button", { class: "button" }, "Back");
      back.addEventListener("click", () => this.welcome.replaceChildren());
      buttons.prepend(back);
    }
    const card = this.say(element("h2", {}, title), element("p", {}, `${said}.`), buttons);
    card.classList.add("failed");
  }

  /** Asks for a file. */
  invite(): void {
    this.say(element("h2", {}, "Open an avatar"), element("p", {}, "Drop a .avatar file here, or choose one."), this.chooser("Choose a file"));
  }

  private say(...content: Node[]): HTMLElement {
    const card = element("div", { class: "card", role: "status" }, ...content);
    this.welcome.replaceChildren(card);
    return card;
  }

  private chooser(label: string): HTMLElement {
    const input = element("input", { type: "file", accept: ".avatar,.zip", hidden: true });
    input.addEventListener("change", () => input.files?.[0] && this.open(input.files[0].arrayBuffer()));
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
      player.playing = !player.playing;
      if (player.playing) this.soundtrack?.unlock();
      this.speak.hidden = true;
      player.update();
      this.showPlaying();
    };
    this.speak.addEventListener("click", toggle);
    this.playButton.addEventListener("click", toggle);
    window.addEventListener("keydown", (event) => {
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
    });
    this.menu.addEventListener("click", () => {
      if (!this.panel) return;
      this.panel.hidden = !this.panel.hidden;
      setIcon(this.menu, this.panel.hidden ? ICONS.settings : ICONS.close);
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
      ` · ${parts.join(" · ")} ms · ${player.renderer.name} · ${size}`);
  }
}
