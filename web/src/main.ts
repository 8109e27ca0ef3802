/** The page: finds a renderer and a bundle, and plays it. */

import style from "./style.css";
import { Conversation } from "./chat/conversation.ts";
import { Player, type View } from "./player.ts";
import { makeRenderer } from "./render/choose.ts";
import type { Light } from "./light/irradiance.ts";
import { App, type Data } from "./ui/app.ts";
import { element } from "./ui/elements.ts";
import { shine } from "./ui/light.ts";

/** Where a page has its bundle, its sound and its lips: in it, in base64, or beside it, named by an attribute. */
const INLINED = "-data", BESIDE = "data-";
/** The light that a page comes with, as JSON, in an attribute. */
const LIGHT = "data-light";

declare global {
  interface Window {
    /** For scripts on the page and for tests: the player, and pictures of single views. */
    smplxppPlayer?: { player: Player; talking: Promise<Conversation | null>; ready: Promise<void>; picture(view: View): Promise<string>; open(data: ArrayBuffer): Promise<void> };
  }
}

async function start(): Promise<void> {
  document.head.append(element("style", {}, style));
  const stage = element("canvas", { class: "stage" });
  document.body.append(stage);
  const wanted = new URLSearchParams(location.search).get("renderer");
  const player = new Player(await makeRenderer(stage, wanted), stage);
  const app = new App(player, stage);
  const light = document.body.getAttribute(LIGHT);
  if (light) {
    const { turn, ...rest } = JSON.parse(light) as Light & { turn: number };
    shine(player, rest, turn);
  }
  const named = new URLSearchParams(location.search).get("avatar");
  const data = named ? download(named) : find("avatar");
  const ready = data ? app.open(data, named ? {} : { sound: find("sound"), lips: find("lips") }) : Promise.resolve(app.invite());
  const secret = document.body.getAttribute("data-chat");
  const talking = ready.then(() => secret && player.summary ? new Conversation(player, secret) : null);
  window.smplxppPlayer = {
    player, talking, ready: talking.then(() => {}),
    open: (bytes) => app.open(bytes),
    picture: async (view) => base64(await player.picture(view)),
  };
}

function find(kind: "avatar" | "sound" | "lips"): Data | null {
  const inlined = document.getElementById(kind + INLINED);
  if (inlined) {
    const bytes = bytesOf(inlined.textContent ?? "");
    inlined.remove();
    return bytes;
  }
  const named = document.body.getAttribute(BESIDE + kind);
  if (!named) return null;
  const bytes = download(named);
  // Sound and lips are awaited after the avatar, whose own failure would leave theirs without a listener.
  bytes.catch(() => {});
  return bytes;
}

async function download(address: string): Promise<ArrayBuffer> {
  // Browsers refuse pages from disk the files beside them, with an error that does not tell why.
  if (location.protocol === "file:" && !/^[a-z]+:/i.test(address))
    throw new Error("This page was opened from disk, where a browser does not let it read the files beside it. " +
      "Serve its folder (smplxpp web --serve, or python -m http.server), or make one file with smplxpp web --single-file.");
  const reply = await fetch(address).catch((error: Error) => {
    const foreign = new URL(address, location.href).origin !== location.origin;
    throw new Error(`${address}: ${error.message}` +
      (foreign ? ". Another site must allow it by Access-Control-Allow-Origin (CORS)." : ""));
  });
  if (!reply.ok) throw new Error(`${address}: the server says ${reply.status} ${reply.statusText}`);
  return reply.arrayBuffer();
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

start().catch((error: Error) => {
  document.body.append(element("div", { class: "welcome" }, element("div", { class: "card failed" },
    element("h2", {}, "This browser cannot show the avatar"), element("p", {}, error.message))));
});
