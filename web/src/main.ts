/** The page of the player, built on the module that other pages embed, which the same file exports. */

import style from "./style.css";
import { Conversation } from "./chat/conversation.ts";
import { createAvatar, type CanvasAvatar, type CanvasOptions } from "./embed/canvas.ts";
import type { Source } from "./embed/source.ts";
import { BACKGROUND, type Player, type View } from "./player.ts";
import type { Light } from "./light/irradiance.ts";
import { App } from "./ui/app.ts";
import { element } from "./ui/elements.ts";
import { shine } from "./ui/light.ts";

/** Where a page has its bundle, its sound and its lips: in it, in base64, or beside it, named by an attribute. */
const INLINED = "-data", BESIDE = "data-";
/** The light that a page comes with, as JSON, in an attribute. */
const LIGHT = "data-light";

declare global {
  interface Window {
    /** For scripts on the page and for tests: the player, and pictures of single views. */
    smplxppPlayer?: { avatar: CanvasAvatar; player: Player; talking: Promise<Conversation | null>; ready: Promise<void>; picture(view: View): Promise<string>; open(data: ArrayBuffer): Promise<void> };
  }
}

async function start(): Promise<void> {
  document.head.append(element("style", {}, style));
  const stage = element("canvas", { class: "stage", tabindex: 0, role: "application", "aria-label": "Avatar" });
  document.body.append(element("main", {}, stage));
  const query = new URLSearchParams(location.search), renderer = query.get("renderer") as CanvasOptions["renderer"];
  const avatar = createAvatar(stage, { renderer, background: BACKGROUND });
  await avatar.ready;
  const app = new App(avatar), player = avatar.player!;
  const light = document.body.getAttribute(LIGHT);
  if (light) {
    const { turn, ...rest } = JSON.parse(light) as Light & { turn: number };
    shine(player, rest, turn);
  }
  const named = query.get("avatar"), data = named ?? find("avatar");
  const ready = data ? app.open(data, named ? {} : { sound: find("sound"), lips: find("lips") }) : Promise.resolve(app.invite());
  const secret = document.body.getAttribute("data-chat");
  const talking = ready.then(() => secret && player.summary ? new Conversation(player, secret) : null);
  window.smplxppPlayer = {
    avatar, player, talking, ready: talking.then(() => {}),
    open: (bytes) => app.open(bytes),
    picture: async (view) => base64(await player.picture(view)),
  };
}

function find(kind: "avatar" | "sound" | "lips"): Source | null {
  const inlined = document.getElementById(kind + INLINED);
  if (!inlined) return document.body.getAttribute(BESIDE + kind);
  const bytes = bytesOf(inlined.textContent ?? "");
  inlined.remove();
  return bytes;
}

function bytesOf(text: string): ArrayBuffer {
  const plain = atob(text.trim()), bytes = new Uint8Array(plain.length);
  for (let i = 0; i < plain.length; ++i) bytes[i] = plain.charCodeAt(i);
  return bytes.buffer;
}

function base64(bytes: Uint8Array): string {
  let plain = "";
  for (let i = 0; i < bytes.length; i += 32768) plain += String.fromCharCode(...bytes.subarray(i, i + 32768));
  return btoa(plain);
}

// Other pages take what is exported, and nothing else is done there.
export * from "./embed/index.ts";
export { AvatarElement } from "./embed/element.ts";

if (document.body?.hasAttribute("data-player")) start().catch((error: Error) => {
  document.body.append(element("div", { class: "welcome" }, element("div", { class: "card failed" },
    element("h1", {}, "This browser cannot show the avatar"), element("p", {}, error.message))));
});
