"""Define Capture: cameras, images read on request, masks, labels, parameters, splits."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from smplxpp.capture.keypoints import shown_keypoints
from smplxpp.capture.recording import KINDS, Problem, Recording, Splits
from smplxpp.capture.views import ArrayCache, ViewReader
from smplxpp.capture.window import Window
from smplxpp.core import BodyParams, Camera, Keypoints2D, TriangleMesh, require_choice
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress

if TYPE_CHECKING:
    from smplxpp.body import BodyModel
    from smplxpp.capture.check import CaptureCheck, CheckConfig


@dataclass(frozen=True, eq=False)
class Capture:
    """A multi-view recording of a person; made by `open_capture`, and usable in workers of a data loader.

    Images are decoded on request and cached within a bound in bytes in each process. `resized` and `cropped` return
    captures with other pixels and matching cameras, over the same files and cache.

    Attributes:
        recording: files and calibration as found on disk.
        splits: cameras and frames for training and for evaluation.
        windows: shown part of each camera's image, and its size.
        cache: cache of decoded images.
        excluded: pairs (camera, frame) that are left out; None stands for all.

    Example:
        >>> capture = smplxpp.open_capture("data/fixtures/person")
        >>> capture.image("Cam001", 0).shape
        (320, 256, 3)
    """

    recording: Recording
    splits: Splits
    windows: Mapping[str, Window]
    cache: ArrayCache
    excluded: frozenset[tuple[str | None, int | None]] = field(default=frozenset())

    def __repr__(self) -> str:
        """One paragraph: the recording, what is shown of it and what it is split into."""
        splits, full = self.splits, self.recording.cameras
        whole = all(window == Window.full(full[name]) for name, window in self.windows.items() if name in full)
        held_out = f"{len(splits.novel_view_cameras)} cameras and {len(splits.novel_pose_frames)} frames held out"
        changed = ["resized or cropped"] * (not whole) + [f"{len(self.excluded)} left out"] * bool(self.excluded)
        return f"Capture({'; '.join([self.recording.summary(), held_out, *changed])})"

    @property
    def name(self) -> str:
        """Name of the capture's folder or description."""
        return self.recording.name

    @property
    def root(self) -> Path:
        """Folder that the capture was opened from."""
        return self.recording.root

    @property
    def format(self) -> str:
        """Name of the layout that the folder was read as."""
        return self.recording.format

    @property
    def protocol(self) -> str | None:
        """Name of the protocol whose files are read; None without one."""
        return self.recording.protocol

    @property
    def kind(self) -> str | None:
        """`recording.TURNTABLE` for a person who turns before one camera; None: all cameras see the same moment."""
        return self.recording.kind

    @property
    def label_set(self) -> str:
        """Name of the label set that defines the numbers of `labels`."""
        return self.recording.label_set

    @property
    def fps(self) -> float | None:
        """Frames per second; None if the data set does not state them."""
        return self.recording.fps

    @property
    def problems(self) -> tuple[Problem, ...]:
        """Problems that were found on opening; `find_problems` also looks into the files."""
        return self.recording.problems

    @cached_property
    def cameras(self) -> dict[str, Camera]:
        """Pinhole cameras of the images after undistortion, resizing and cropping."""
        return {name: self.windows[name].camera(camera) for name, camera in self.recording.cameras.items()}

    @cached_property
    def frames(self) -> tuple[int, ...]:
        """Frames with an image in any camera, ascending; without images, the frames with parameters."""
        dropped = {frame for camera, frame in self.excluded if camera is None}
        return tuple(frame for frame in self.recording.frames() if frame not in dropped)

    def check(
        self,
        body: BodyModel | None = None,
        config: CheckConfig | None = None,
        *,
        progress: ProgressCallback = ignore_progress,
    ) -> CaptureCheck:
        """Find everything that would spoil a training: files, splits, masks, parameters, calibration.

        Args:
            body: the model that the parameters are for; None: the open body.
            config: how much is looked at.
            progress: called with the share of the views that are checked.

        Returns:
            The findings, and `failed`: whether one of them has to be corrected before a training.

        Raises:
            InputError: frames that the capture does not have.

        Example:
            >>> check = smplxpp.open_capture("data/fixtures/person").check()
            >>> [finding.message for finding in check.findings if finding.status == "fail"]
            []
        """
        # `smplxpp.capture.check` imports this module, so that it is imported at the call.
        if body is None:
            body = import_module("smplxpp.body").load_body()
        return import_module("smplxpp.capture.check").check_capture(self, body, config, progress=progress)

    def file(self, camera: str, frame: int, kind: str = "image") -> Path | None:
        """Return the file of a view, None without one. Kinds: image, mask, label, normal."""
        require_choice("kind", kind, KINDS)
        self._full_camera(camera)
        if {(camera, frame), (None, frame), (camera, None)} & self.excluded:
            return None
        series = self.recording.series(kind, camera)
        return None if series is None else series.path(frame)

    def required_file(self, camera: str, frame: int) -> Path:
        """Return the image file of a view that must exist.

        Raises:
            InputError: no such camera, or no image.
        """
        path = self.file(camera, frame)
        if path is None:
            raise InputError(
                f"image of camera {camera}, frame {frame}",
                expected="an image that was there on opening (see `presence`)",
                received="none",
            )
        return path

    def presence(self, kind: str = "image") -> Bool[np.ndarray, "C F"]:
        """Return for each camera and frame whether there is a file of a kind, without opening files."""
        # (C, F): a row for each camera in the recording's order, a column for each frame.
        table = np.zeros((len(self.recording.cameras), len(self.frames)), dtype=bool)
        numbers = np.array(self.frames, dtype=np.int64)
        for row, camera in enumerate(self.recording.cameras):
            series = self.recording.series(kind, camera)
            if series is not None and (camera, None) not in self.excluded:
                table[row] = series.has(numbers)
        rows, columns = {c: i for i, c in enumerate(self.recording.cameras)}, {f: i for i, f in enumerate(self.frames)}
        # Single excluded views; whole cameras are left out above.
        for without, when in self.excluded:
            if without in rows and when in columns:
                table[rows[without], columns[when]] = False
        return table

    def views(self, cameras: Iterable[str] | None = None, frames: Iterable[int] | None = None) -> list[tuple[str, int]]:
        """Return (camera, frame) of every image of the given cameras and frames (None: all), frame by frame."""
        names = list(self.recording.cameras)
        table = self.presence()
        wanted_cameras = set(names if cameras is None else cameras)
        for camera in wanted_cameras:
            self._full_camera(camera)
        wanted_frames = set(self.frames if frames is None else frames)
        # Frame by frame, so that neighbours in the list show one pose.
        columns = [k for k, frame in enumerate(self.frames) if frame in wanted_frames]
        rows = [k for k, name in enumerate(names) if name in wanted_cameras]
        return [(names[r], self.frames[c]) for c in columns for r in rows if table[r, c]]

    def image(self, camera: str, frame: int) -> UInt8[np.ndarray, "H W 3"]:
        """Return the image of a view, sRGB as recorded, read-only.

        Raises:
            InputError: no such camera, no file, a damaged file, or one of another size than the calibration's.
        """
        path = self.required_file(camera, frame)
        return self._cached("image", camera, frame, lambda reader: (reader.color(path),))[0]

    def mask(self, camera: str, frame: int) -> UInt8[np.ndarray, "H W"] | None:
        """Return the opacity of the person, 255 inside, read-only; None without a mask.

        Raises:
            InputError: no such camera, a damaged file, or one of another size.
        """
        path = self.file(camera, frame, "mask")
        if path is None:
            return None
        return self._cached("mask", camera, frame, lambda reader: (reader.alpha(path),))[0]

    def labels(self, camera: str, frame: int) -> UInt8[np.ndarray, "H W"] | None:
        """Return the label map in numbers of `label_set`, nearest neighbour; None without a map."""
        path = self.file(camera, frame, "label")
        if path is None:
            return None
        return self._cached("label", camera, frame, lambda reader: (reader.labels(path),))[0]

    def normals(self, camera: str, frame: int) -> Float32[np.ndarray, "H W 3"] | None:
        """Return unit normals in the world, 0 on the background; None without a map."""
        path = self.file(camera, frame, "normal")
        if path is None:
            return None
        return self._cached("normal", camera, frame, lambda reader: (reader.normals(path),))[0]

    def composited(
        self, camera: str, frame: int, background: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> Float32[np.ndarray, "H W 3"]:
        """Return the person on a plain background, (H, W, 3) float32 sRGB in [0, 1].

        `C = F + (1 - a) B` with a the mask and F the image times a, mixed in sRGB. For photographs F is formed before
        resampling; for images that a capture declares as composited on a colour c, `F = I - (1 - a) c`.

        Raises:
            InputError: as `image` and `mask`; no mask; or images that are not on the colour the capture declares.
        """
        foreground, alpha = self.foreground(camera, frame)
        # sRGB in [0, 1]; F is already multiplied by the opacity.
        out = np.multiply(foreground, np.float32(1 / 255), dtype=np.float32)
        colour = np.asarray(background, dtype=np.float32).reshape(3)
        # A black background adds nothing, so that the pass over the image is saved.
        if colour.any():
            transparent = 1.0 - alpha * np.float32(1 / 255)
            for channel in range(3):
                out[..., channel] += transparent * colour[channel]
            # Errors of JPEG may have left the product brighter than its opacity.
            np.minimum(out, 1.0, out=out)
        return out

    def foreground(self, camera: str, frame: int) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"]]:
        """Return colour times opacity, (H, W, 3) uint8, and opacity, (H, W) uint8, both read-only.

        Raises:
            InputError: as `composited`.
        """
        image = self.required_file(camera, frame)
        # Without a mask there is no opacity, and a background made up would be trained on.
        mask = self.file(camera, frame, "mask")
        if mask is None:
            raise InputError(
                f"mask of camera {camera}, frame {frame}",
                expected=f"a mask for the image {image}",
                received="none",
                remedy="give a folder of masks (open_capture(..., masks=DIR)), or make them with your matting model",
            )
        colour, opacity = self._cached("foreground", camera, frame, lambda reader: reader.foreground(image, mask))
        return colour, opacity

    def params(self, frame: int) -> BodyParams | None:
        """Return the body parameters of one frame, None without any.

        Raises:
            InputError: a damaged file, NaN or infinity in the frame.
        """
        source = self.recording.params
        if source is None or (None, frame) in self.excluded or frame not in source.frames():
            return None
        return source.read(frame)

    def keypoints(self, camera: str) -> Keypoints2D | None:
        """Return the detected keypoints of a camera in pixels of `cameras[camera]`; None without any.

        Points are undistorted, resized and cropped like the images (points outside the window keep coordinates outside
        of it). Excluded frames are left out. The file is read at each call.

        Raises:
            InputError: no such camera, a damaged file.
        """
        full, source = self._full_camera(camera), self.recording.keypoints
        found = None if source is None else source.read(camera)
        if found is None:
            return None
        # Keypoints of excluded frames go too: the check found them to belong to a defective view.
        dropped = {frame for name, frame in self.excluded if name in (camera, None)}
        kept = [frame for frame in found.frames.tolist() if frame not in dropped]
        if len(kept) < len(found.frames):
            found = found.select(found.names, kept)
        # From pixels of the file (distorted, full size) to those of the shown image.
        return shown_keypoints(found, full, self.windows[camera], self.recording.distortions.get(camera))

    def keypoint_notes(self) -> tuple[str, ...]:
        """Return sentences about the people in view and whose keypoints were taken."""
        return () if self.recording.keypoints is None else self.recording.keypoints.notes()

    def truth_mesh(self, frame: int) -> TriangleMesh | None:
        """Return the true surface of a frame as the images show it; None if the data set has none."""
        return None if self.recording.meshes is None else self.recording.meshes.read(frame)

    def resized(self, scale: float) -> Capture:
        """Return the capture at `scale` times the resolution; sizes are rounded, and intrinsics match them."""
        return replace(self, windows={name: window.resized(scale) for name, window in self.windows.items()})

    def cropped(self, boxes: Mapping[str, tuple[int, int, int, int]]) -> Capture:
        """Return the capture with images of some cameras cropped to x0, y0, x1, y1 in pixels of this capture."""
        for camera in boxes:
            self._full_camera(camera)
        cut = {name: self.windows[name].cropped(box) for name, box in boxes.items()}
        return replace(self, windows={**self.windows, **cut})

    def without(self, problems: Iterable[Problem]) -> Capture:
        """Return the capture without the views, frames and cameras that the problems name."""
        excluded = self.excluded | {(p.camera, p.frame) for p in problems if (p.camera, p.frame) != (None, None)}
        # An exclusion without a frame is of a whole camera, one without a camera of a whole frame.
        dropped_cameras = {camera for camera, frame in excluded if frame is None}
        dropped_frames = {frame for camera, frame in excluded if camera is None}
        recording = replace(
            self.recording,
            cameras={name: c for name, c in self.recording.cameras.items() if name not in dropped_cameras},
        )
        kept_frames = [frame for frame in self.frames if frame not in dropped_frames]
        # Splits may not name cameras or frames that no longer exist.
        splits = self.splits.restricted(list(recording.cameras), kept_frames)
        return replace(self, recording=recording, splits=splits, excluded=frozenset(excluded))

    def reader(self, camera: str) -> ViewReader:
        """Return the reader of a camera's files in its window, without the cache."""
        full, recording = self._full_camera(camera), self.recording
        return ViewReader(full, self.windows[camera], recording.distortions.get(camera), recording.background)

    def _full_camera(self, name: str) -> Camera:
        if name not in self.recording.cameras:
            have = ", ".join(self.recording.cameras) or "no camera"
            raise InputError(
                f"camera of capture {self.name}",
                expected=f"one of {have}",
                received=str(name),
            )
        return self.recording.cameras[name]

    def _cached(
        self, kind: str, camera: str, frame: int, make: Callable[[ViewReader], tuple[np.ndarray, ...]]
    ) -> tuple[np.ndarray, ...]:
        return self.cache.get((kind, camera, frame, self.windows[camera]), lambda: make(self.reader(camera)))
