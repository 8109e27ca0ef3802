"""Write a tracker's keypoints and a parser's label maps for a capture with exact inputs, and protocols that name both.

All files follow from the capture's files and the seed alone.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from pipelines.synth.tracker import DetectorConfig, detector_keypoints, estimated_labels
from smplxpp.body import BodyModel
from smplxpp.capture import Capture
from smplxpp.capture.files import FileSeries
from smplxpp.capture.keypoints import moved_keypoints
from smplxpp.capture.views import read_labels
from smplxpp.capture.writers.frame_files import write_gray_png, write_keypoints
from smplxpp.core import BACKGROUND, BodyParams, Camera
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
