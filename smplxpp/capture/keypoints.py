"""Find the keypoint files of a capture, and map keypoints into its images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.keypoint_files import KeypointFormat, KeypointOptions
from smplxpp.capture.keypoint_places import KeypointFiles, find_places
from smplxpp.capture.recording import Recording
from smplxpp.capture.window import Window
from smplxpp.core import Camera, InputError, Keypoints2D


def with_keypoints(recording: Recording, folder: Path, options: KeypointOptions | None = None) -> Recording:
    """Return the recording with keypoints from `folder` only: a file or folder for each camera, in any layout.

    Raises:
        InputError: no such folder, or no keypoints of any camera in it.
    """
    if not folder.is_dir():
        raise InputError("folder of keypoints", expected="an existing folder", received=str(folder))
    files = _files(folder, recording.cameras, options or KeypointOptions())
    if not files.places:
        example = next(iter(recording.cameras), "CAM")
        raise InputError(
            f"folder of keypoints {folder}",
            expected=f"a file or a folder for each camera, such as {example}.npz or {example}/",
            received=", ".join(sorted(path.name for path in folder.iterdir())[:6]) or "nothing",
        )
    return replace(recording, keypoints=files)


def found_keypoints(
    folder: Path, cameras: Mapping[str, Camera], *, format: KeypointFormat, person: int | None
) -> KeypointFiles | None:
    """Return the keypoints that a data set contains; None without its folder of keypoints."""
    if not folder.is_dir():
        return None
    files = _files(folder, cameras, KeypointOptions(format=format, person=person))
    return files if files.places else None


def shown_keypoints(found: Keypoints2D, full: Camera, window: Window, distortion: Distortion | None) -> Keypoints2D:
    """Map keypoints of the image on disk into a window of the undistorted image."""
    if distortion is not None:
        found = moved_keypoints(found, full, distortion.undistort)
    x0, y0 = window.box[:2]
    return replace(found, points=(found.points - (x0, y0)) * window.scale)


def moved_keypoints(
    found: Keypoints2D, camera: Camera, change: Callable[[Float64[np.ndarray, "N 2"]], Float64[np.ndarray, "N 2"]]
) -> Keypoints2D:
    """Apply a map of the plane z = 1 to keypoints; points that it maps to NaN get confidence 0."""
    # Only seen points are mapped: the others lie at (0, 0), which a lens may map to infinity.
    there, K = found.confidence > 0, camera.K
    # Pixel to the plane z = 1: x = K^-1 (u - c), for row vectors with the transpose.
    plane = change((found.points[there] - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T)
    points, confidence = found.points.copy(), found.confidence.copy()
    points[there] = plane @ K[:2, :2].T + K[:2, 2]
    confidence[~np.isfinite(points).all(axis=-1)] = 0.0
    return replace(found, points=points, confidence=confidence)


def _files(folder: Path, cameras: Mapping[str, Camera], options: KeypointOptions) -> KeypointFiles:
    sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
    return KeypointFiles(find_places(folder, cameras), options, sizes)
