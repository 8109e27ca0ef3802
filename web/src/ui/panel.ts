/** What can be set: parts, face, pose; and what the avatar is. */

import type { Player } from "../player.ts";
import { element, slider, toggle } from "./elements.ts";
import { lightPage } from "./light.ts";
import { lipsPage } from "./lips.ts";

const TURN = { least: -90, most: 90, start: 0, step: 1 };
const AXES = ["Bend", "Twist", "Tilt"];

/** Makes the panel of the avatar that is open. @param fail says what is wrong with a file. */
export function makePanel(player: Player, fail: (message: string, title: string) => void): HTMLElement {
  const about = player.summary!;
  const pages: [string, HTMLElement][] = [];
  if (about.partNames.length > 1) pages.push(["Parts", parts(player)]);
  if (about.expressionNames.length) pages.push(["Face", face(player)]);
  if (player.lips) pages.push(["Voice", page(lipsPage(player))]);
  const light = lightPage(player, (message) => fail(message, "This light cannot be shown"));
  pages.push(["Pose", pose(player)], ["Light", page(light)], ["About", details(player)]);

  const tabs = element("div", { class: "tabs", role: "tablist", "aria-label": "Settings" });
  const buttons = pages.map(([name, page]) => {
    const id = name.toLowerCase();
    page.id = `page-${id}`;
    page.setAttribute("aria-labelledby", `tab-${id}`);
    return element("button", { role: "tab", id: `tab-${id}`, "aria-controls": page.id }, name);
  });
  // One stop of the Tab key; arrows go on from there.
  const show = (chosen: number, focused = false) => {
    pages.forEach(([, page], k) => (page.hidden = k !== chosen));
    buttons.forEach((tab, k) => {
      tab.setAttribute("aria-selected", String(k === chosen));
      tab.tabIndex = k === chosen ? 0 : -1;
    });
    if (focused) buttons[chosen].focus();
  };
  buttons.forEach((tab, k) => tab.addEventListener("click", () => show(k)));
  tabs.append(...buttons);
  tabs.addEventListener("keydown", (event) => {
    const last = pages.length - 1, now = buttons.indexOf(event.target as HTMLButtonElement);
    const next: Record<string, number> = { ArrowRight: now < last ? now + 1 : 0, ArrowLeft: now > 0 ? now - 1 : last, Home: 0, End: last };
    if (now < 0 || !(event.key in next)) return;
    event.preventDefault();
    show(next[event.key], true);
  });
  const panel = element("section", { class: "panel", id: "settings", "aria-label": "Settings", hidden: true }, tabs, ...pages.map(([, page]) => page));
  show(0);
  return panel;
}

function page(...children: (Node | string)[]): HTMLElement {
  return element("div", { class: "page", role: "tabpanel", tabindex: 0 }, ...children);
}

/** "left_up_arm" as people write it. */
function readable(name: string): string {
  const words = name.replaceAll("_", " ").replace(/([a-z])([A-Z])/g, "$1 $2").toLowerCase();
  return words.charAt(0).toUpperCase() + words.slice(1);
}

function parts(player: Player): HTMLElement {
  const rows = player.summary!.partNames.map((name, part) => {
    return toggle(readable(name), (shown) => {
      if (shown) player.hidden.delete(part);
      else player.hidden.add(part);
      player.update();
    });
  });
  if (player.summary!.garments.length) {
    rows.push(toggle("Clothes are simulated", (simulated) => {
      player.simulating = simulated;
      player.update();
    }, player.simulating));
  }
  return page(...rows);
}

function face(player: Player): HTMLElement {
  const reset = element("button", { class: "button" }, "Back to the motion");
  const rows = element("div");
  const fill = () => rows.replaceChildren(...player.summary!.expressionNames.map((name, k) =>
    slider(readable(name), { least: 0, most: 1, start: 0, step: 0.01 }, (value) => {
      player.expressions.set(k, value);
      player.update();
    })));
  reset.addEventListener("click", () => {
    player.expressions.clear();
    player.update();
    fill();
  });
  fill();
  return page(rows, reset);
}

function pose(player: Player): HTMLElement {
  const names = player.summary!.jointNames;
  const select = element("select", { "aria-label": "Joint" },
    ...names.map((name, joint) => element("option", { value: joint }, readable(name))));
  const rows = element("div");
  const fill = () => {
    const joint = Number(select.value);
    const turn = [...(player.turns.get(joint) ?? [0, 0, 0])] as [number, number, number];
    rows.replaceChildren(...AXES.map((axis, k) =>
      slider(`${axis}, degrees`, { ...TURN, start: Math.round((turn[k] * 180) / Math.PI) }, (value) => {
        turn[k] = (value * Math.PI) / 180;
        if (turn.some((angle) => angle !== 0)) player.turns.set(joint, [...turn]);
        else player.turns.delete(joint);
        player.update();
      })));
  };
  select.addEventListener("change", fill);
  const shoulder = names.indexOf("left_shoulder");
  if (shoulder >= 0) select.value = String(shoulder);
  const reset = element("button", { class: "button" }, "Turn all joints back");
  reset.addEventListener("click", () => {
    player.turns.clear();
    player.update();
    fill();
  });
  fill();
  return page(select, rows, reset);
}

function details(player: Player): HTMLElement {
  const about = player.summary!, list = element("dl");
  const say = (name: string, value: string) => list.append(element("dt", {}, name), element("dd", {}, value));
  say("Name", about.name);
  say("Gaussians", about.count.toLocaleString("en"));
  say("File", `${(about.bytes / 1e6).toFixed(1)} MB`);
  if (about.motion) say("Motion", `${about.motion.frames} frames, ${about.motion.framesPerSecond.toFixed(0)} a second`);
  say("Renderer", player.renderer.name);
  if (about.licence) say("Licence", about.licence);
  for (const [name, value] of Object.entries(about.provenance)) say(readable(name), String(value));
  return page(list);
}
