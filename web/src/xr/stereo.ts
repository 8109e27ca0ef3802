/** The avatar in a headset: two views by WebGL2 of what the worker makes for the middle of the head. */

import { BACKGROUND, type Player } from "../player.ts";
import type { Camera } from "../render/camera.ts";
import { WebGL2Renderer, type Window } from "../render/webgl2.ts";
import { makeLayer, system, type XRFrame, type XRLayer, type XRTransform, type XRView } from "./webxr.ts";

/** Metres: how far before the viewer the avatar stands, the eyes' height where the floor is not known, the near plane. */
const AWAY = 2, EYES = 1.6, NEAR = 0.05;
/** Pixels of the camera that only orders the Gaussians. */
const NOMINAL = 512;

/** Whether a headset can be entered from this page. */
export async function offersStereo(): Promise<boolean> {
  return (await system()?.isSessionSupported("immersive-vr").catch(() => false)) ?? false;
}

/**
 * Shows the player's avatar in the headset, life-sized, on the floor before the viewer, until that leaves.
 *
 * @throws Error the browser refuses.
 */
export async function enterStereo(player: Player): Promise<void> {
  const session = await system()!.requestSession("immersive-vr", { optionalFeatures: ["local-floor"] });
  const ended = new Promise<void>((resolve) => session.addEventListener("end", resolve));
  try {
    const renderer = new WebGL2Renderer(document.createElement("canvas"));
    const layer = makeLayer(session, await renderer.compatible());
    await session.updateRenderState({ baseLayer: layer, depthNear: NEAR });
    const [space, floor] = await session.requestReferenceSpace("local-floor").then(
      (found) => [found, 0] as const,
      async () => [await session.requestReferenceSpace("local"), -EYES] as const,
    );
    const { middle, reach } = player.summary!;
    // From the page's world to the headset's.
    const shift = [-middle[0], floor - (middle[1] - reach), -AWAY - middle[2]];
    let count = 0, light: Float32Array | null = null;
    player.immersed = true;
    player.update();
    const draw = (now: number, frame: XRFrame): void => {
      if (!player.immersed) return;
      session.requestAnimationFrame(draw);
      player.advance(now);
      const pose = frame.getViewerPose(space);
      if (!pose || renderer.lost) return;
      player.update();
      const fresh = player.next(() => placed(pose.transform, shift, { fx: NOMINAL, fy: NOMINAL, cx: NOMINAL / 2, cy: NOMINAL / 2, width: NOMINAL, height: NOMINAL }));
      if (fresh) {
        renderer.upload(new Float32Array(fresh.records), fresh.count);
        count = fresh.count;
        light = player.lightOf(fresh);
        player.done(fresh);
      }
      const shown = { count, background: BACKGROUND, blur: player.summary!.blur, light };
      for (const window of pose.views.flatMap((view) => windowOf(view, layer, shift))) renderer.paint(window, layer.framebuffer, shown);
    };
    session.requestAnimationFrame(draw);
    await ended;
  } catch (error) {
    await session.end().catch(() => {});
    throw error;
  } finally {
    player.immersed = false;
    player.update();
  }
}

function windowOf(view: XRView, layer: XRLayer, shift: readonly number[]): Window[] {
  const port = layer.getViewport(view), P = view.projectionMatrix;
  if (!port?.width || !port.height) return [];
  const { x, y, width, height } = port;
  // OpenGL looks along -z, with y up: x_ndc = P0 x / -z - P8, and y likewise.
  const pinhole = {
    fx: 0.5 * width * P[0], fy: 0.5 * height * P[5], cx: 0.5 * width * (1 - P[8]), cy: 0.5 * height * (1 + P[9]), width, height,
  };
  return [{ camera: placed(view.transform, shift, pinhole), x, y }];
}

/** OpenCV's camera of a place in the headset's space, over the page's world. */
function placed(transform: XRTransform, shift: readonly number[], pinhole: Omit<Camera, "view">): Camera {
  const m = transform.inverse.matrix;
  const view = [1, -1, -1].flatMap((sign, r) => {
    const row = [m[r], m[4 + r], m[8 + r]].map((value) => sign * value);
    return [...row, sign * m[12 + r] + row.reduce((sum, value, k) => sum + value * shift[k], 0)];
  });
  return { ...pinhole, view };
}
