/** Cameras: OpenCV's axes (x right, y down, z forward), world to camera, pixel centres at +0.5. */

export interface Camera {
  /** (3, 4) rows, camera from world. */
  view: number[];
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  width: number;
  height: number;
}

export const NEAR = 0.01;

/** The centre of projection in the world. */
export function eye({ view: v }: Camera): [number, number, number] {
  return [0, 1, 2].map((k) => -(v[k] * v[3] + v[4 + k] * v[7] + v[8 + k] * v[11])) as [number, number, number];
}

/** A camera on a sphere around a point, +Y up. */
export interface Orbit {
  target: [number, number, number];
  /** Metres. */
  distance: number;
  /** Radians: 0 looks along -z, from before the person; positive goes to the person's left. */
  azimuth: number;
  /** Radians above the horizon. */
  elevation: number;
}

const FIELD_OF_VIEW = 0.6;

/** The pinhole camera of an orbit for a picture of so many pixels; upright it sees about 34 degrees. */
export function orbitCamera(orbit: Orbit, width: number, height: number): Camera {
  const { azimuth: a, elevation: e, distance, target } = orbit;
  const back = [Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e)];
  const right = [Math.cos(a), 0, -Math.sin(a)];
  const forward = back.map((value) => -value);
  // y = z cross x: down.
  const down = [
    forward[1] * right[2] - forward[2] * right[1],
    forward[2] * right[0] - forward[0] * right[2],
    forward[0] * right[1] - forward[1] * right[0],
  ];
  const place = target.map((value, k) => value + distance * back[k]);
  const view = [right, down, forward].flatMap((row) => [...row, -row.reduce((sum, r, k) => sum + r * place[k], 0)]);
  const focal = (0.5 * height) / Math.tan(0.5 * FIELD_OF_VIEW);
  return { view, fx: focal, fy: focal, cx: width / 2, cy: height / 2, width, height };
}

/** Moves the target by pixels of the picture, as if it were dragged. */
export function panned(orbit: Orbit, dx: number, dy: number, camera: Camera): Orbit {
  const unit = orbit.distance / camera.fy, v = camera.view;
  const target = orbit.target.map((value, k) => value - unit * (dx * v[k] + dy * v[4 + k]));
  return { ...orbit, target: target as Orbit["target"] };
}
