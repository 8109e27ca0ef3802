"""Keypoints of a capture by a detector: a file a camera, and nothing detected twice.

A file remembers of which image and mask, by their content, and by which detector each frame's points are; what still
holds is kept when the command runs again.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from pipelines.figures import contact_sheet
from pipelines.figures.body_drawings import draw_keypoints
from smplxpp.capture import Capture
from smplxpp.capture.keypoint_files import read_keypoints
from smplxpp.capture.views import read_alpha, read_color
from smplxpp.capture.writers.arrays import write_keypoints
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.core.files.array_file import read_arrays
from smplxpp.core.files.paths import read_bytes
from smplxpp.core.keypoints import Keypoints2D
from smplxpp.detect import Box, DetectedPerson, Detector, mask_box

# A kill loses at most this many seconds of detecting.
_SAVE_EVERY_S = 20.0
_NAMED = 8
# The grey that takes a background's place; opacity below which a pixel is background; how far, of 255, the background
# may be from its declared colour.
_GREY, _OUTSIDE, _SAME_COLOR = 150.0, 8, 6.0


@dataclass(frozen=True, eq=False)
class DetectedCamera:
    """What was found in one camera's images.

    Attributes:
        keypoints: of the surest person of each frame, or of the one whom the mask shows; pixels of the files.
        people: a frame, how many were seen. detected: how many frames were looked at now, the others stood.
    """

    keypoints: Keypoints2D
    people: np.ndarray
    detected: int

    def frames_with(self, count: Callable[[np.ndarray], np.ndarray]) -> list[int]:
        """Numbers of the frames in which so many people were seen."""
        return self.keypoints.frames[count(self.people)].tolist()


def detect_keypoints(
    capture: Capture,
    detector: Detector,
    folder: Path,
    *,
    cameras: Sequence[str] | None = None,
    frames: Iterable[int] | None = None,
    progress: ProgressCallback = ignore_progress,
) -> dict[str, DetectedCamera]:
    """Detect keypoints in the images of a capture and write `folder/CAM.npz`, which `open_capture(keypoints=folder)`
    reads.

    Images are taken as they lie on disk, distorted where they are. Where a view has a mask, the person is looked for in
    its box. Frames that stand in a file and are not asked for are kept.

    Args:
        capture: at full size. cameras: None: those that training may see; held-out cameras have to be named.
        frames: None: all.

    Raises:
        InputError: unknown cameras, no images, a damaged image; nobody in any image.
    """
    names = capture.splits.train_cameras if cameras is None else tuple(cameras)
    wanted = None if frames is None else set(frames)
    views = {name: [frame for _, frame in capture.views([name], wanted)] for name in names}
    total = sum(map(len, views.values()))
    if not total:
        raise InputError(
            f"capture {capture.name}",
            expected="images of the cameras and frames to look at",
            received="none",
            remedy="name cameras with --cameras; held-out ones are left out by default",
        )
    found, done = {}, 0
    for name, numbers in views.items():
        if not numbers:
            continue
        work = _CameraWork(capture, detector, folder / f"{name}.npz", name)
        for frame in numbers:
            work.look(frame)
            done += 1
            progress("images", done / total)
        found[name] = work.finish()
    if not any((one.people > 0).any() for one in found.values()):
        raise InputError(
            f"images of capture {capture.name}",
            expected="a person in them",
            received=f"nobody in any of {total}",
            remedy="look at the images (upright? lit?), give masks, or name another detector",
        )
    return found


def problems_of(found: dict[str, DetectedCamera], held_out: Iterable[str] = ()) -> tuple[str, ...]:
    """What a user should know, in words: views without anybody, with several people, and of held-out cameras."""
    out = []
    for name, one in found.items():
        none, several = one.frames_with(lambda n: n == 0), one.frames_with(lambda n: n > 1)
        if none:
            out.append(f"camera {name}: nobody was found in {_in_words(none, len(one.people))}")
        if several:
            who = "the one in the mask, or else the surest, is taken"
            out.append(f"camera {name}: more than one person in {_in_words(several, len(one.people))}; {who}")
    apart = [name for name in found if name in set(held_out)]
    if apart:
        out.append(f"held-out cameras {', '.join(apart)}: their keypoints are for measuring, training never reads them")
    return tuple(out)


def detection_sheet(
    capture: Capture, found: Mapping[str, DetectedCamera], *, height: int = 480, most: int = 16
) -> UInt8[np.ndarray, "H W 3"]:
    """One photograph a camera, with its points: the frame that the most cameras have, of at most `most` cameras."""
    import PIL.Image

    frames = np.concatenate([one.keypoints.frames for one in found.values()])
    numbers, counts = np.unique(frames, return_counts=True)
    frame = int(numbers[counts.argmax()])
    pictures: list[np.ndarray] = []
    captions: list[str] = []
    for name, one in found.items():
        (rows,) = np.nonzero(one.keypoints.frames == frame)
        if not len(rows) or len(pictures) == most:
            continue
        image = read_color(capture.required_file(name, frame))
        scale = height / image.height
        small = image.resize((max(round(scale * image.width), 1), height), PIL.Image.Resampling.LANCZOS)
        points, sure = scale * one.keypoints.points[rows[0]], one.keypoints.confidence[rows[0]]
        pictures.append(draw_keypoints(np.asarray(small), one.keypoints.names, points, sure))
        captions.append(f"{name}, frame {frame}")
    return contact_sheet(pictures, captions=captions)


class _CameraWork:
    """The file of one camera while it grows."""

    def __init__(self, capture: Capture, detector: Detector, path: Path, camera: str) -> None:
        self.capture, self.detector, self.path, self.camera = capture, detector, path, camera
        self.rows = standing_rows(path, detector)
        self.detected, self.saved_at = 0, time.monotonic()

    def look(self, frame: int) -> None:
        """Detect in one frame, unless that stands."""
        image_file = self.capture.required_file(self.camera, frame)
        mask_file = self.capture.file(self.camera, frame, "mask")
        mask = None if mask_file is None else np.asarray(read_alpha(mask_file))
        files = [path for path in (image_file, mask_file) if path is not None]
        key = hashlib.sha256(b"".join(hashlib.sha256(read_bytes(path)).digest() for path in files)).hexdigest()
        if frame in self.rows and self.rows[frame].key == key:
            return
        image = np.asarray(read_color(image_file))
        alone = None if mask is None else _on_grey(image, mask, self.capture.recording.background)
        image = image if alone is None else alone
        box = None if mask is None else mask_box(mask)
        people = self.detector(image, box)
        if not people and box is not None:
            people = self.detector(image)
        self.rows[frame] = _Row(key, _chosen(people, box), len(people) if alone is None else min(len(people), 1))
        self.detected += 1
        if time.monotonic() - self.saved_at > _SAVE_EVERY_S:
            self._save()

    def finish(self) -> DetectedCamera:
        """Write the file, where it changed, and return what is in it."""
        if self.detected or not self.path.is_file():
            self._save()
        return DetectedCamera(self._keypoints(), self._people(), self.detected)

    def _save(self) -> None:
        held_out = self.camera in self.capture.splits.novel_view_cameras
        extra = {
            "image_digest": np.array([self.rows[frame].key for frame in sorted(self.rows)], dtype=str),
            "people": self._people(),
            "detector": np.array([self.detector.identity]),
            "held_out": np.array([held_out]),
        }
        write_keypoints(self.path, self._keypoints(), extra)
        self.saved_at = time.monotonic()

    def _people(self) -> np.ndarray:
        return np.array([self.rows[frame].people for frame in sorted(self.rows)], dtype=np.int64)

    def _keypoints(self) -> Keypoints2D:
        frames = sorted(self.rows)
        table = np.zeros((len(frames), len(self.detector.names), 3))
        for row, frame in enumerate(frames):
            person = self.rows[frame].person
            if person is not None:
                table[row] = np.column_stack([person.points, person.confidence])
        return Keypoints2D(self.detector.names, np.array(frames, dtype=np.int64), table[..., :2], table[..., 2])


@dataclass(frozen=True, eq=False)
class _Row:
    """One frame: what it was detected in, who, and how many were seen."""

    key: str
    person: DetectedPerson | None
    people: int


def standing_rows(path: Path, detector: Detector) -> dict[int, _Row]:
    """The frames of a file that this detector made; none where there is no file, or another detector's.

    Raises:
        InputError: a file that is no detector's record, which is not written over.
    """
    if not path.is_file():
        return {}
    arrays = read_arrays(path, subject="keypoints")
    keys, people = (np.ravel(arrays.get(name, ())) for name in ("image_digest", "people"))
    who = np.ravel(arrays.get("detector", ()))
    stands = read_keypoints(path)
    if not len(keys) == len(people) == len(stands.frames) or people.dtype.kind not in "iu" or len(who) != 1:
        raise InputError(
            f"file {path}",
            expected="no file, or one that `smplxpp keypoints detect` wrote",
            received="another",
            remedy="name another folder",
        )
    if str(who[0]) != detector.identity or stands.names != detector.names:
        return {}
    rows = zip(stands.frames.tolist(), keys, people, stands.points, stands.confidence, strict=True)
    return {
        frame: _Row(str(key), DetectedPerson(points, confidence) if count else None, int(count))
        for frame, key, count, points, confidence in rows
    }


def _on_grey(
    image: UInt8[np.ndarray, "H W 3"], mask: UInt8[np.ndarray, "H W"], background: Sequence[float] | None
) -> UInt8[np.ndarray, "H W 3"] | None:
    """The person alone on grey, of an image that a capture declares as put on a colour.

    Dark hair is not found on black. None where nothing is declared, or the image is not on that colour.
    """
    outside = mask < _OUTSIDE if background is not None and mask.shape == image.shape[:2] else np.zeros(1, dtype=bool)
    if background is None or not outside.any():
        return None
    color = 255.0 * np.asarray(background, dtype=np.float32)
    if np.median(np.abs(image[outside] - color)) > _SAME_COLOR:
        return None
    moved = image + (1.0 - mask[..., None] / np.float32(255.0)) * (_GREY - color)
    return np.clip(np.round(moved), 0, 255).astype(np.uint8)


def _chosen(people: Sequence[DetectedPerson], box: Box | None) -> DetectedPerson | None:
    """The surest, of those who fill the box best where there is one."""
    if not people or box is None:
        return next(iter(people), None)
    return max(people, key=lambda one: (round(_overlap(one.box, box), 1), one.total_confidence))


def _overlap(a: Box, b: Box) -> float:
    """Intersection over union."""
    width = max(min(a[2], b[2]) - max(a[0], b[0]), 0.0)
    height = max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)
    areas = [(one[2] - one[0]) * (one[3] - one[1]) for one in (a, b)]
    return width * height / max(sum(areas) - width * height, 1e-9)


def _in_words(frames: Sequence[int], count: int) -> str:
    if len(frames) == count and count > 1:
        return f"all {count} frames"
    more = f" and {len(frames) - _NAMED} more" if len(frames) > _NAMED else ""
    return f"frame{'s' if len(frames) > 1 else ''} {', '.join(map(str, frames[:_NAMED]))}{more}"
