/** Pointers, wheel and keys that move the camera. */

import type { Player } from "../player.ts";
import { panned } from "../render/camera.ts";

const TURN = 0.0055, WHEEL = 0.0012, KEY_TURN = 0.08;
const CLOSEST = 0.15, FARTHEST = 40, STEEPEST = 1.5;

/**
 * One pointer turns, two (or the right button, or Shift) move and pinch, the wheel goes nearer; double click: all back.
 *
 * @param keys whose keys move the camera, too. @param signal ends it.
 */
export function listen(stage: HTMLElement, player: Player, keys: HTMLElement = stage, signal?: AbortSignal): void {
  const pointers = new Map<number, { x: number; y: number }>();

  const turn = (dx: number, dy: number) => {
    const { orbit } = player;
    const elevation = Math.min(STEEPEST, Math.max(-STEEPEST, orbit.elevation + dy));
    player.orbit = { ...orbit, azimuth: orbit.azimuth + dx, elevation };
    player.update();
  };
  const zoom = (factor: number) => {
    const distance = Math.min(FARTHEST, Math.max(CLOSEST, player.orbit.distance * factor));
    player.orbit = { ...player.orbit, distance };
    player.update();
  };
  const pan = (dx: number, dy: number) => {
    const camera = player.camera(), ratio = camera.width / stage.clientWidth;
    player.orbit = panned(player.orbit, dx * ratio, dy * ratio, camera);
    player.update();
  };

  stage.addEventListener("pointerdown", (event) => {
    stage.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }, { signal });
  for (const name of ["pointerup", "pointercancel"] as const) {
    stage.addEventListener(name, (event) => pointers.delete(event.pointerId), { signal });
  }
  stage.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before || !player.summary) return;
    const now = { x: event.clientX, y: event.clientY };
    const [dx, dy] = [now.x - before.x, now.y - before.y];
    if (pointers.size === 1) {
      if (event.buttons & 6 || event.shiftKey) pan(dx, dy);
      else turn(-TURN * dx, TURN * dy);
    } else if (pointers.size === 2) {
      const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const apart = (at: { x: number; y: number }) => Math.max(1, Math.hypot(at.x - other.x, at.y - other.y));
      zoom(apart(before) / apart(now));
      pan(dx / 2, dy / 2);
    }
    pointers.set(event.pointerId, now);
  }, { signal });
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    if (player.summary) zoom(Math.exp(WHEEL * event.deltaY * (event.deltaMode ? 20 : 1)));
  }, { passive: false, signal });
  stage.addEventListener("contextmenu", (event) => event.preventDefault(), { signal });
  stage.addEventListener("dblclick", () => player.resetView(), { signal });
  keys.addEventListener("keydown", (event) => {
    const free = event.target === keys || event.target === stage;
    if (!free || event.ctrlKey || event.altKey || event.metaKey || !player.summary) return;
    const moves: Record<string, () => void> = {
      ArrowLeft: () => turn(-KEY_TURN, 0), ArrowRight: () => turn(KEY_TURN, 0),
      ArrowUp: () => turn(0, KEY_TURN), ArrowDown: () => turn(0, -KEY_TURN),
      "+": () => zoom(0.9), "-": () => zoom(1.1), Home: () => player.resetView(),
    };
    if (!moves[event.key]) return;
    event.preventDefault();
    moves[event.key]();
  }, { signal });
}
