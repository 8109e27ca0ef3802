/** The page of live sound: the mouth follows the microphone or a sound's file. */

import type { Player } from "../player.ts";
import { element } from "./elements.ts";

/** Makes what the settings have of it. */
export function lipsPage(player: Player): HTMLElement {
  const lips = player.lips!, said = element("p", { class: "hint", role: "status" });
  const microphone = element("button", { class: "button" }, "Microphone"), file = element("button", { class: "button" }, "Sound file");
  const stop = element("button", { class: "button", hidden: true }, "Stop");
  const input = element("input", { type: "file", accept: "audio/*,video/*", hidden: true, "aria-label": "Sound file" });
  const begin = (message: string) => {
    said.textContent = message || "The mouth follows a voice, in any language, by this page alone: nothing is sent anywhere.";
    stop.hidden = !lips.source;
    player.update();
  };
  microphone.addEventListener("click", () => void lips.listen());
  file.addEventListener("click", () => input.click());
  stop.addEventListener("click", () => lips.stop());
  input.addEventListener("change", async () => {
    const chosen = input.files?.[0];
    input.value = "";
    if (chosen) await lips.play(await chosen.arrayBuffer(), chosen.name);
  });
  lips.onsaid = begin;
  begin("");
  return element("div", {}, said, microphone, file, stop, input);
}
