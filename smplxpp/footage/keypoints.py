"""Detect the keypoints of a capture's images: one file for each camera, and no frame twice.

A file records the digest of image and mask of each frame, and the detector. Frames whose record is up to date are kept
when the command runs again.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from smplxpp.capture import Capture
from smplxpp.capture.keypoint_files import read_keypoints
from smplxpp.capture.views import read_alpha, read_color
from smplxpp.capture.writers import write_keypoints
from smplxpp.core import InputError, Keypoints2D, ProgressCallback, ignore_progress
from smplxpp.core.errors import one_line
from smplxpp.core.files import read_arrays, read_bytes
from smplxpp.detect import Box, DetectedPerson, Detector, mask_box
from smplxpp.figures import contact_sheet
from smplxpp.figures.drawings import draw_keypoints

_SAVE_EVERY_S = 20.0  # a file is written this often, so that a kill loses at most that much work


@dataclass(frozen=True, eq=False)
class DetectedCamera:
    """The detections in one camera's images.

    Attributes:
        keypoints: keypoints of the most confident person of each frame, or of the one in the mask; pixels of the files.
        people: number of people in each frame.
        detected: number of frames that this run has looked at; the others were kept.
    """

    keypoints: Keypoints2D
    people: np.ndarray
    detected: int

    __repr__ = one_line

    def frames_with(self, count: Callable[[np.ndarray], np.ndarray]) -> list[int]:
        """Return the numbers of the frames whose count of people meets a condition."""
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
    """Detect keypoints in the images of a capture and write `folder/CAM.npz` for `open_capture(keypoints=folder)`.

    Images are read as they are on disk, distorted if they are. Where a view has a mask, the person is detected in its
    box. Frames of an existing file that were not requested are kept.

    Args:
        capture: the capture at full size.
        detector: the keypoint detector.
        folder: folder of the files.
        cameras: names of cameras; None: those that training may see. Held-out cameras have to be named.
        frames: numbers of frames; None: all.
        progress: called with the share of the images that is done.

    Raises:
        InputError: unknown cameras, no images, a damaged image, or no person in any image.
    """
    # List the views first, so that a request without images fails at once.
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
    # Each camera's file grows while its frames are looked at.
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
            received=f"no person in any of {total}",
            remedy="look at the images (upright? lit?), give masks, or name another detector",
        )
    return found


def detection_notes(found: dict[str, DetectedCamera], held_out: Iterable[str] = ()) -> tuple[str, ...]:
    """Return notes on views without a person, with several people, and on held-out cameras."""
    out = []
    for name, one in found.items():
        none, several = one.frames_with(lambda n: n == 0), one.frames_with(lambda n: n > 1)
        if none:
            out.append(f"camera {name}: no person was detected in {_listed(none, len(one.people))}")
        if several:
            who = "the one in the mask, or else the most confident, is taken"
            out.append(f"camera {name}: more than one person in {_listed(several, len(one.people))}; {who}")
    apart = [name for name in found if name in set(held_out)]
    if apart:
        out.append(f"held-out cameras {', '.join(apart)}: their keypoints are for measuring, training never reads them")
    return tuple(out)


def detection_sheet(
    capture: Capture, found: Mapping[str, DetectedCamera], *, height: int = 480, most: int = 16
) -> UInt8[np.ndarray, "H W 3"]:
    """Return a contact sheet with one image and its keypoints a camera, for at most `most` cameras.

    It shows the frame that most cameras have.
    """
    import PIL.Image

    # The frame that most cameras have.
    frames = np.concatenate([one.keypoints.frames for one in found.values()])
    numbers, counts = np.unique(frames, return_counts=True)
    frame = int(numbers[counts.argmax()])
    pictures: list[np.ndarray] = []
    captions: list[str] = []
    for name, one in found.items():
        # Cameras without that frame are left out.
        (rows,) = np.nonzero(one.keypoints.frames == frame)
        if not len(rows) or len(pictures) == most:
            continue
        image = read_color(capture.required_file(name, frame))
        scale = height / image.height
        small = image.resize((max(round(scale * image.width), 1), height), PIL.Image.Resampling.LANCZOS)
        points, confidence = scale * one.keypoints.points[rows[0]], one.keypoints.confidence[rows[0]]
        pictures.append(draw_keypoints(np.asarray(small), one.keypoints.names, points, confidence))
        captions.append(f"{name}, frame {frame}")
    return contact_sheet(pictures, captions=captions)


class _CameraWork:
    """The growing file of one camera and its detections."""

    def __init__(self, capture: Capture, detector: Detector, path: Path, camera: str) -> None:
        self.capture, self.detector, self.path, self.camera = capture, detector, path, camera
        self.rows = kept_rows(path, detector)
        self.detected, self.saved_at = 0, time.monotonic()

    def look(self, frame: int) -> None:
        """Detect in one frame, unless the file has it for the same image, mask and detector."""
        image_file = self.capture.required_file(self.camera, frame)
        mask_file = self.capture.file(self.camera, frame, "mask")
        mask = None if mask_file is None else np.asarray(read_alpha(mask_file))
        files = [path for path in (image_file, mask_file) if path is not None]
        key = hashlib.sha256(b"".join(hashlib.sha256(read_bytes(path)).digest() for path in files)).hexdigest()
        if frame in self.rows and self.rows[frame].key == key:
            return
        # A person alone on a declared background is put on grey, and looked for in the mask's box, then anywhere.
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
        """Write the file if it changed, and return its content."""
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
        # Frames without a person have confidence 0.
        table = np.zeros((len(frames), len(self.detector.names), 3))
        for row, frame in enumerate(frames):
            person = self.rows[frame].person
            if person is not None:
                table[row] = np.column_stack([person.points, person.confidence])
        return Keypoints2D(self.detector.names, np.array(frames, dtype=np.int64), table[..., :2], table[..., 2])


@dataclass(frozen=True, eq=False)
class _Row:
    """The detection of one frame, as a file records it.

    Attributes:
        key: SHA-256 of its image and mask.
        person: the chosen person; None without any.
        people: number of people.
    """

    key: str
    person: DetectedPerson | None
    people: int


def kept_rows(path: Path, detector: Detector) -> dict[int, _Row]:
    """Return the frames of a file by this detector; none without a file, or for another detector's.

    Raises:
        InputError: a file that is no record of a detector, which is never overwritten.
    """
    if not path.is_file():
        return {}
    arrays = read_arrays(path, subject="keypoints")
    keys, people = (np.ravel(arrays.get(name, ())) for name in ("image_digest", "people"))
    who = np.ravel(arrays.get("detector", ()))
    # A file without records of images, people and detector has another origin.
    stands = read_keypoints(path)
    if not len(keys) == len(people) == len(stands.frames) or people.dtype.kind not in "iu" or len(who) != 1:
        raise InputError(
            f"file {path}",
            expected="no file, or one that `smplxpp keypoints detect` wrote",
            received="another",
            remedy="name another folder",
        )
    # Detections of another detector are made again.
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
    """Return the person on grey, for an image whose capture declares the colour of its background.

    Detectors miss dark hair on black. None where no colour is declared, or the image is not on that colour.
    """
    # Pixels below 3 % opacity have to be within 6 levels of the declared colour.
    outside = mask < 8 if background is not None and mask.shape == image.shape[:2] else np.zeros(1, dtype=bool)
    if background is None or not outside.any():
        return None
    color = 255.0 * np.asarray(background, dtype=np.float32)
    if np.median(np.abs(image[outside] - color)) > 6.0:
        return None
    # Exchange the background's share in every pixel.
    moved = image + (1.0 - mask[..., None] / np.float32(255.0)) * (150.0 - color)
    return np.clip(np.round(moved), 0, 255).astype(np.uint8)


def _chosen(people: Sequence[DetectedPerson], box: Box | None) -> DetectedPerson | None:
    """Return the most confident person, of those with the largest overlap with the box if there is one."""
    if not people or box is None:
        return next(iter(people), None)
    return max(people, key=lambda one: (round(_overlap(one.box, box), 1), one.total_confidence))


def _overlap(a: Box, b: Box) -> float:
    """Return the intersection over union of two boxes."""
    width = max(min(a[2], b[2]) - max(a[0], b[0]), 0.0)
    height = max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)
    areas = [(one[2] - one[0]) * (one[3] - one[1]) for one in (a, b)]
    return width * height / max(sum(areas) - width * height, 1e-9)


def _listed(frames: Sequence[int], count: int) -> str:
    if len(frames) == count and count > 1:
        return f"all {count} frames"
    more = f" and {len(frames) - 8} more" if len(frames) > 8 else ""
    return f"frame{'s' if len(frames) > 1 else ''} {', '.join(map(str, frames[:8]))}{more}"
