/** The page of another light: what panorama, on and off, turned about the vertical. */

import { harmonicsOf, WHITE, type Light } from "../light/irradiance.ts";
import { readRadiance } from "../light/radiance.ts";
import type { Player } from "../player.ts";
import { element, slider, toggle } from "./elements.ts";

const TURN = { least: -180, most: 180, start: 0, step: 1 };

/** A panorama's file as a light in the place of the capture's, which is taken for white. @throws Error it cannot be read. */
export function lightOf(data: ArrayBuffer, name: string): Light {
  return { name, light: harmonicsOf(readRadiance(new Uint8Array(data))), captured: WHITE };
}

/** Shows the avatar in a light. */
export function shine(player: Player, light: Light, degrees = 0): void {
  player.light = light;
  player.lit = true;
  player.lightTurn = (degrees * Math.PI) / 180;
  player.update();
  player.onlight();
}

/** Makes what the settings have of it. @param fail says why a file cannot be read. */
export function lightPage(player: Player, fail: (message: string) => void): HTMLElement {
  const rows = element("div");
  const input = element("input", { type: "file", accept: ".hdr", hidden: true, "aria-label": "Panorama" });
  input.addEventListener("change", async () => {
    const file = input.files?.[0];
    input.value = "";
    if (file) await file.arrayBuffer().then((data) => shine(player, lightOf(data, file.name))).catch((error: Error) => fail(error.message));
  });
  const button = element("button", { class: "button" }, "Choose a panorama");
  button.addEventListener("click", () => input.click());
  const fill = () => {
    const { light } = player;
    if (!light) {
      rows.replaceChildren(element("p", { class: "hint" }, "Drop a panorama (.hdr) on the page to show the avatar in its light."));
      return;
    }
    rows.replaceChildren(
      toggle(light.name, (on) => {
        player.lit = on;
        player.update();
      }, player.lit),
      slider("Turned, degrees", { ...TURN, start: Math.round((player.lightTurn * 180) / Math.PI) }, (value) => {
        player.lightTurn = (value * Math.PI) / 180;
        player.update();
      }),
    );
  };
  player.onlight = fill;
  fill();
  return element("div", {}, rows, button, input);
}
