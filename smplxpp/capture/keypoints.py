"""Find the keypoint files of a capture, read them on request, and map keypoints into its images."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import matched_names, subfolders
from smplxpp.capture.keypoint_files import (
    KeypointFormat,
    KeypointOptions,
    frame_files,
    read_keypoints,
    sampled_people,
)
from smplxpp.capture.keypoint_people import body_25_order
from smplxpp.capture.recording import Recording
from smplxpp.capture.window import Window
from smplxpp.core import Camera, InputError, Keypoints2D

_SUFFIXES = (".npz", ".json")


@dataclass(frozen=True, eq=False)
class KeypointFiles:
    """Keypoint files by camera, read on request.

    Attributes:
        places: file or folder of each camera with keypoints.
        options: options for reading.
        sizes: width and height of each camera's images on disk.
    """

    places: Mapping[str, Path]
    options: KeypointOptions = field(default_factory=KeypointOptions)
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    def cameras(self) -> tuple[str, ...]:
        """Return the names of the cameras with keypoints."""
        return tuple(self.places)

    def read(self, camera: str) -> Keypoints2D | None:
        """Read the keypoints of a camera, None without any.

        Raises:
            InputError: as `read_keypoints`.
        """
        return None if camera not in self.places else read_keypoints(self.places[camera], self.options_of(camera))

    def frames(self) -> tuple[int, ...]:
        """Return the frames with keypoints in any camera, by the names of files where there is a file a frame."""
        found: set[int] = set()
        for camera, path in self.places.items():
            if path.is_dir() and self.options.first_frame is None:
                found |= set(frame_files(path))
            elif (one := self.read(camera)) is not None:
                found |= set(one.frames.tolist())
        return tuple(sorted(found))

    def notes(self) -> tuple[str, ...]:
        """Return nothing: each view is read by itself."""
        return ()

    def options_of(self, camera: str) -> KeypointOptions:
        """Return the options for a camera's files: its image size, and the order of points common to all cameras."""
        size = self.sizes.get(camera, self.options.size)
        return replace(self.options, size=size, format=self._format)

    @cached_property
    def _format(self) -> KeypointFormat:
        """The format; OpenPose's order of 25 points is recognised from all cameras together."""
        if self.options.format != "auto":
            return self.options.format
        order = body_25_order(people for path in self.places.values() for people in sampled_people(path))
        return order if order in ("openpose", "openpose-25b") else "auto"


def find_places(folder: Path, cameras: Iterable[str] | None = None) -> dict[str, Path]:
    """Find the keypoints of each camera: the folder of its name, or the file (`CAM.npz`, `CAM.json`, `CAM_more.json`,
    `results_CAM.json`).

    Args:
        folder: folder with a file or a folder for each camera.
        cameras: names of the cameras; None: every file and every folder belongs to a camera.
    """
    # A folder of the camera's name wins over files, since OpenPose writes a file a frame.
    inside = set(subfolders(folder))
    files = sorted(p for p in folder.iterdir() if p.is_file() and p.suffix.lower() in _SUFFIXES)
    if cameras is None:
        return {name: folder / name for name in sorted(inside)} | {_camera_of(path): path for path in files}
    found: dict[str, Path] = {}
    cameras = list(cameras)
    for camera in cameras:
        if camera in inside:
            found[camera] = folder / camera
            continue
        # "cam1" must not match the file of "cam10": no digit may follow the name.
        own = [path for path in files if re.match(rf"(results_)?{re.escape(camera)}(?!\d)", path.stem)]
        # Prefer the exact name, then the shortest: additions such as dates make names longer.
        own.sort(key=lambda path: (_camera_of(path) != camera, len(path.stem)))
        if own:
            found[camera] = own[0]
    # Other spellings: `cam01_json` of a camera `cam_01`.
    missing = [camera for camera in cameras if camera not in found]
    free = {p.name if p.is_dir() else _camera_of(p): p for p in [*(folder / name for name in sorted(inside)), *files]}
    free = {name: path for name, path in free.items() if path not in found.values()}
    more = {camera: free[name] for camera, name in matched_names(missing, list(free)).items()}
    return {camera: (found | more)[camera] for camera in cameras if camera in found or camera in more}


def _camera_of(path: Path) -> str:
    return path.stem.removeprefix("results_").removesuffix("_keypoints")


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
