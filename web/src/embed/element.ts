/** `<smplxpp-avatar src="me.avatar" lips="lips.safetensors" view="chest" controls></smplxpp-avatar>`: importing this defines it. */

import type { AvatarEvents, MotionParams, PlayOptions, PoseParams } from "./avatar.ts";
import { createAvatar, type CanvasAvatar, type CanvasOptions, type CanvasSettings } from "./canvas.ts";

const EVENTS = ["ready", "picture", "end", "saying", "said", "error"] as const satisfies (keyof AvatarEvents)[];

/**
 * An avatar as an element. Its attributes are read when it comes into the page: `src`, `lips`, `sound`, `environment`,
 * `background`, `view`, `controls`, `paused`, `renderer`, `worker`, and `label`, which screen readers say. Events of the
 * avatar are its own, with what they tell in `detail`.
 */
export class AvatarElement extends HTMLElement {
  /** null while the element is in no page. */
  avatar: CanvasAvatar | null = null;
  /** Options that attributes cannot hold, such as `voice`; to be set before the element comes into the page. */
  options: CanvasOptions = {};

  connectedCallback(): void {
    if (this.avatar) return;
    const canvas = document.createElement("canvas"), root = this.shadowRoot ?? this.attachShadow({ mode: "open" }), label = this.getAttribute("label");
    canvas.style.cssText = "display: block; width: 100%; height: 100%";
    if (label !== null) canvas.setAttribute("aria-label", label);
    if (label !== null) canvas.setAttribute("role", "img");
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(":host { display: block; width: 320px; height: 480px } :host([hidden]) { display: none }");
    root.adoptedStyleSheets = [sheet];
    root.replaceChildren(canvas);
    const named = (name: string) => this.getAttribute(name) ?? undefined;
    const avatar = (this.avatar = createAvatar(canvas, {
      url: named("src"), lips: named("lips"), sound: named("sound"), environment: named("environment"), background: named("background"),
      view: named("view") as CanvasOptions["view"], renderer: named("renderer") as CanvasOptions["renderer"], worker: named("worker"),
      controls: this.hasAttribute("controls"), autoplay: !this.hasAttribute("paused"), ...this.options,
    }));
    for (const event of EVENTS) avatar.on(event, (detail) => this.dispatchEvent(new CustomEvent(event, { detail })));
  }

  disconnectedCallback(): void {
    // An element that only moves comes back at once.
    queueMicrotask(() => {
      if (this.isConnected) return;
      this.avatar?.dispose();
      this.avatar = null;
    });
  }

  get ready(): Promise<void> {
    return this.shown().ready;
  }

  play(motion: MotionParams | null = null, options: PlayOptions = {}): Promise<void> {
    return this.shown().play(motion, options);
  }

  pause(): void {
    this.shown().pause();
  }

  stand(): Promise<void> {
    return this.shown().stand();
  }

  pose(params: PoseParams | null): Promise<void> {
    return this.shown().pose(params);
  }

  say(what: Parameters<CanvasAvatar["say"]>[0]): Promise<boolean> {
    return this.shown().say(what);
  }

  hush(): void {
    this.shown().hush();
  }

  set(settings: CanvasSettings): Promise<void> {
    return this.shown().set(settings);
  }

  private shown(): CanvasAvatar {
    if (!this.avatar) throw new Error("smplxpp-avatar: expected an element in a page, received one outside");
    return this.avatar;
  }
}

if (!customElements.get("smplxpp-avatar")) customElements.define("smplxpp-avatar", AvatarElement);
