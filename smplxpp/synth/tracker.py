"""Add the errors of trackers to exact data, and write what they would give of a capture, for a fixed seed.

Parameters, keypoints and label maps as arrays, then the files and the protocols that name both kinds of inputs; all
follow from the exact data and the seed alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt, gaussian_filter

from smplxpp.body import BodyModel
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.capture import Capture
from smplxpp.capture.files import FileSeries
from smplxpp.capture.keypoints import moved_keypoints
from smplxpp.capture.views import read_labels
from smplxpp.capture.writers import write_gray_png, write_keypoints
from smplxpp.core import (
    BACKGROUND,
    BodyParams,
    Camera,
    matrix_from_rotvec,
    require_between,
    require_positive,
    rotvec_from_matrix,
)
from smplxpp.core.keypoints import Keypoints2D
from smplxpp.raster import rasterize_mesh
from smplxpp.segment.labels import find_label_set

KEYPOINTS, ESTIMATED_LABELS = "keypoints", "labels_estimated"
EXACT_PARAMETERS, TRACKED_PARAMETERS = "params.npz", "params_noisy.npz"
INPUTS = {
    "parameters": {EXACT_PARAMETERS: "exact", TRACKED_PARAMETERS: "tracked"},
    "labels": "true",
    "normals": "true",
}
"""The entry "inputs" of the description of a capture with exact and tracked files."""


@dataclass(frozen=True)
class DetectorConfig:
    """Sizes and shares of a keypoint detector's errors.

    Attributes:
        pixels: standard deviation of a coordinate in an image 640 pixels high; it is proportional to the height, and
            doubled for hidden points.
        outliers: share of points that lie anywhere in the person's box instead.
        missing: share of points that are not detected.

    Raises:
        InputError: shares out of range.
    """

    pixels: float = 3.0
    outliers: float = 0.05
    missing: float = 0.10

    def __post_init__(self) -> None:
        require_positive("pixels", self.pixels)
        for name in ("outliers", "missing"):
            require_between(name, getattr(self, name), 0.0, 1.0)


def tracker_noise(
    params: BodyParams,
    *,
    seed: int,
    degrees: float = 1.5,
    transl: float = 0.008,
    expression: float = 0.04,
    betas: float = 0.12,
) -> BodyParams:
    """Return parameters with the errors of a tracker.

    Args:
        params: exact parameters.
        seed: seed of the errors.
        degrees: standard deviation of each joint's rotation about each axis.
        transl: standard deviation of each coordinate in metres, half white noise, half a slow sine.
        expression: standard deviation of expression weights.
        betas: standard deviation of one constant offset of the shape coefficients.
    """
    rng = np.random.default_rng(seed)
    count = len(params)
    # Random rotations on top of every joint's own.
    turns = matrix_from_rotvec(rng.normal(0, np.radians(degrees), (count, len(SMPLX_JOINTS), 3)))
    pose = rotvec_from_matrix(turns @ matrix_from_rotvec(params.full_pose))
    # One period of a sine over the sequence, and white noise, of equal variance.
    phase = rng.uniform(0, 2 * np.pi, 3) + 2 * np.pi * np.arange(count)[:, None] / max(count, 2)
    slow, white = np.sin(phase) * np.sqrt(2), rng.normal(size=(count, 3))
    tracked = BodyParams.from_full_pose(
        pose,
        betas=params.betas + rng.normal(0, betas, params.betas.shape[1]),
        expression=np.clip(params.expression + rng.normal(0, expression, params.expression.shape), 0, 1),
        transl=params.transl + transl * np.sqrt(0.5) * (slow + white),
    )
    return replace(tracked, fps=params.fps, flat_hand_mean=params.flat_hand_mean)


def detector_keypoints(
    points: Float[np.ndarray, "F K 3"],
    camera: Camera,
    *,
    names: Sequence[str],
    frames: Sequence[int],
    seed: int | Sequence[int],
    visible: Bool[np.ndarray, "F K"] | None = None,
    config: DetectorConfig | None = None,
) -> Keypoints2D:
    """Return the keypoints that a detector would find in the images of a camera.

    Args:
        points: named points in each frame, world, metres.
        camera: the camera; points outside its images are not found.
        names: names of the points.
        frames: numbers of the frames.
        seed: seed of this camera's errors.
        visible: which points nothing hides; hidden ones get more noise and less confidence. None: all.
        config: size of the errors.
    """
    config = config or DetectorConfig()
    rng = np.random.default_rng(seed)
    shape = (len(frames), len(names))
    screen = camera.screen_from_world(points.reshape(-1, 3)).reshape(*shape, 4)
    size = np.array([camera.width, camera.height], dtype=np.float64)
    # Project; points outside the image or nearer than 5 cm are not detected.
    with np.errstate(invalid="ignore"):
        inside = (screen[..., 2] > 0.05) & ((screen[..., :2] >= 0) & (screen[..., :2] <= size)).all(axis=2)
    uv = np.where(inside[..., None], screen[..., :2], 0.0)
    # Gaussian noise, twice as much where a point is hidden.
    hidden = np.zeros(shape, dtype=bool) if visible is None else ~visible
    noise = config.pixels * camera.height / 640.0 * np.where(hidden, 2.0, 1.0)
    found = uv + rng.normal(size=uv.shape) * noise[..., None]
    # Outliers lie anywhere in the box of the person's points.
    low = np.where(inside[..., None], uv, np.inf).min(axis=1, keepdims=True)
    high = np.where(inside[..., None], uv, -np.inf).max(axis=1, keepdims=True)
    low, high = np.where(np.isfinite(low), low, 0.0), np.where(np.isfinite(high), high, 0.0)
    wrong = rng.random(shape) < config.outliers
    anywhere = low + rng.random(uv.shape) * (high - low)
    # Ranges of confidence overlap, because detectors are not always less certain of hidden or wrong points.
    limits = np.where(hidden[..., None], (0.15, 0.55), (0.6, 1.0))
    limits = np.where(wrong[..., None], (0.15, 0.8), limits)
    confidence = limits[..., 0] + rng.random(shape) * (limits[..., 1] - limits[..., 0])
    missed = (rng.random(shape) < config.missing) | ~inside
    return Keypoints2D(
        tuple(names),
        np.array(frames, dtype=np.int64),
        np.where(wrong[..., None], anywhere, found),
        np.where(missed, 0.0, confidence),
    )


def estimated_labels(
    labels: UInt8[np.ndarray, "H W"],
    *,
    seed: int | Sequence[int],
    share: float = 0.05,
    background: Sequence[int] = (0,),
) -> UInt8[np.ndarray, "H W"]:
    """Return a label map with the errors of a parser: displaced borders between labels, and wrong blobs beside them.

    The person's outline stays, because it comes from the matte. The displacement is as large as makes about `share` of
    the foreground wrong, less where labels share hardly a border.

    Args:
        labels: label numbers of any set.
        seed: seed of this view's errors.
        share: share of the foreground's pixels that become wrong.
        background: label numbers of the background.
    """
    foreground = ~np.isin(labels, background)
    if not foreground.any() or (labels[foreground] == labels[foreground][0]).all():
        return labels.copy()
    rng = np.random.default_rng(seed)
    height = labels.shape[0]
    # Continue the labels outside the outline, so that a border that meets it can move there.
    rows, columns = distance_transform_edt(~foreground, return_distances=False, return_indices=True)
    full = labels[rows, columns]
    # A smooth displacement field (0.03 of the image's height), tripled within blobs (0.008 of it, 12 % of the area).
    shift = np.stack([_smooth(rng, labels.shape, 0.03 * height) for _ in range(2)])
    blobs = _smooth(rng, labels.shape, max(0.008 * height, 1.0))
    shift = shift * np.where(blobs > np.quantile(blobs, 1.0 - 0.12), 3.0, 1.0)
    # Only the person's pixels change.
    pixels, shift, exact = np.stack(np.nonzero(foreground)), shift[:, foreground], labels[foreground]
    limit = np.array(labels.shape)[:, None] - 1
    # Of 24 amplitudes keep the one whose share of wrong pixels is nearest to the wanted one.
    best, best_error = exact, np.inf
    for amplitude in np.geomspace(0.25, max(0.06 * height, 0.5), 24):
        y, x = np.clip(np.round(pixels + amplitude * shift).astype(np.int64), 0, limit)
        moved = full[y, x]
        error = abs(float((moved != exact).mean()) - share)
        if error < best_error:
            best, best_error = moved, error
    out = labels.copy()
    out[foreground] = best
    return out


def _smooth(rng: np.random.Generator, shape: tuple[int, ...], scale: float) -> Float[np.ndarray, "H W"]:
    """Return smooth noise of unit standard deviation."""
    noise = gaussian_filter(rng.normal(size=shape), scale, mode="reflect")
    return noise / noise.std()


def protocols(*, labels: bool = True, normals: bool = True, keypoints: bool = True) -> dict[str, dict[str, object]]:
    """Return the entry "protocols" of a capture's description, given the kinds of files that it has."""
    return {
        # `exact` reads the truth: no keypoints are needed. `tracked` reads what trackers and parsers give, without the
        # true normals and labels of the scan.
        "exact": {
            "parameters": EXACT_PARAMETERS,
            "labels": "labels" if labels else None,
            "scan_labels": True,
            "normals": "normals" if normals else None,
            "keypoints": None,
        },
        "tracked": {
            "parameters": TRACKED_PARAMETERS,
            "labels": ESTIMATED_LABELS if labels else None,
            "scan_labels": False,
            "normals": None,
            "keypoints": KEYPOINTS if keypoints else None,
        },
    }


def write_tracked_keypoints(
    root: Path,
    capture: Capture,
    body: BodyModel,
    params: dict[int, BodyParams],
    *,
    seed: int,
    config: DetectorConfig | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> None:
    """Write `keypoints/CAM.npz` of every camera: all joints of the body with a detector's errors.

    Joints that the body itself hides get more noise and less confidence; clothes hide nothing.

    Args:
        root: folder of the capture.
        capture: gives the cameras, at full size.
        body: body model of the parameters.
        params: exact parameters by frame.
        seed: seed of the detector's errors.
        config: size of the errors.
        progress: called with the share of the cameras that is done.
    """
    frames = sorted(params)
    posed = body.forward(BodyParams.concatenate([params[frame] for frame in frames]))
    for k, (name, camera) in enumerate(capture.cameras.items()):
        found = detector_keypoints(
            posed.joints,
            camera,
            names=body.joint_names,
            frames=frames,
            seed=[seed, 11, k],
            visible=_visible(body, posed.vertices, posed.joints, camera),
            config=config,
        )
        lens = capture.recording.distortions.get(name)
        if lens is not None:  # the images on disk are distorted
            found = moved_keypoints(found, camera, lens.distort)
        write_keypoints(root / KEYPOINTS / f"{name}.npz", found)
        progress((k + 1) / len(capture.cameras))


def write_estimated_labels(
    root: Path, capture: Capture, *, seed: int, progress: Callable[[float], None] = lambda share: None
) -> float:
    """Write `labels_estimated/CAM/CAM_labelFFFFFF.png` for every label map of a capture in our layout.

    Returns:
        The share of foreground pixels whose label is wrong, over all maps; 0 without any.
    """
    of_set = find_label_set(capture.label_set).ours
    # Labels of the capture's set that stand for background count neither as wrong nor as foreground.
    background = [number for number, ours in of_set.items() if ours == BACKGROUND]
    wrong = seen = 0
    for k, name in enumerate(capture.cameras):
        series = capture.recording.series("label", name)
        if series is None:
            continue

        def one(frame: int, k: int = k, name: str = name, series: FileSeries = series) -> tuple[int, int]:
            path = series.required(frame)
            exact = np.asarray(read_labels(path))
            estimated = estimated_labels(exact, seed=[seed, 12, k, frame], background=background)
            write_gray_png(root / ESTIMATED_LABELS / name / f"{path.stem}.png", estimated)
            foreground = ~np.isin(exact, background)
            return int((estimated != exact)[foreground].sum()), int(foreground.sum())

        with ThreadPoolExecutor(2) as pool:
            counts = list(pool.map(one, series.numbers.tolist()))
        wrong, seen = wrong + sum(w for w, _ in counts), seen + sum(s for _, s in counts)
        progress((k + 1) / len(capture.cameras))
    return wrong / seen if seen else 0.0


def _visible(
    body: BodyModel, vertices: Float[np.ndarray, "F V 3"], joints: Float[np.ndarray, "F J 3"], camera: Camera
) -> Bool[np.ndarray, "F J"]:
    """Return which joints the body's own surface does not hide; those outside the image count as visible."""
    # Joints lie inside the body, so only surface more than 15 cm nearer to the camera hides them.
    out = np.ones(joints.shape[:2], dtype=bool)
    for row, (surface, points) in enumerate(zip(vertices, joints, strict=True)):
        depth = rasterize_mesh(body.mesh(surface), camera).depth
        screen = camera.screen_from_world(points)
        with np.errstate(invalid="ignore"):
            inside = (screen[:, 2] > 0) & (screen[:, :2] >= 0).all(axis=1)
            inside &= (screen[:, 0] < camera.width) & (screen[:, 1] < camera.height)
        # Compare the depth image at the joint with the joint's own depth.
        x, y = screen[inside, :2].astype(np.int64).T
        out[row, inside] = depth[y, x] > screen[inside, 2] - 0.15
    return out
