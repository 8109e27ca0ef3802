"""Make a capture of a person who turns before one camera: frames, masks, keypoints, then camera and poses."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.body import BodyModel, load_body
from smplxpp.capture import Capture, MattingModel, open_capture, write_mattes
from smplxpp.capture.keypoint_files import read_keypoints
from smplxpp.capture.recording import TURNTABLE
from smplxpp.capture.views import read_alpha
from smplxpp.capture.writers import (
    JPEG_SUFFIXES,
    view_path,
    write_gray_png,
    write_jpeg,
    write_keypoints,
    write_plain_cameras_json,
)
from smplxpp.core import (
    Camera,
    InputError,
    ProgressCallback,
    ignore_progress,
    require_at_least,
    require_between,
)
from smplxpp.core.files import atomic_folder, atomic_write_bytes, atomic_write_text, jsonable, read_bytes
from smplxpp.detect import load_detector
from smplxpp.footage.keypoints import detect_keypoints
from smplxpp.footage.turn_frames import (
    Lens,
    TurnFrame,
    files_of_frames,
    is_turned,
    keypoints_of_frames,
    lens_of,
    turn_frames,
    upright_image,
)
from smplxpp.register import Observations
from smplxpp.register.turntable import (
    LEAST_FRAMES,
    TurntableConfig,
    TurntableFit,
    leveled,
    register_turntable,
    turn_notes,
)

CAMERA = "cam"
"""Name of the one camera."""
# Of 20 frames and more every tenth is held out, so that a training can be measured; never the first, the reference.
_HOLD_OUT_FROM, _HOLD_OUT_EVERY = 20, 10


@dataclass(frozen=True)
class TurntableCaptureConfig:
    """Options of a capture of a person who turns.

    Attributes:
        height: of the person with shoes, metres; None: a guess of the shape prior.
        focal_mm: focal length of the lens, millimetres of 35 mm film; None: of the photograph's Exif record, else
            unknown.
        most_frames: number of frames that are taken, evenly spread.
        masks: folder of masks, called or sorted as the frames; None: they are made.
        keypoints: folder or file of keypoints of any detector; None: they are detected.
        matting: ONNX model that makes the masks; None: MediaPipe's segmentation.
        detector: "mediapipe", or an ONNX model.
        hold_out: rows of the frames that neither shape nor training may see, to measure on; never 0, the reference;
            empty: `held_out_frames`.
    """

    height: float | None = None
    focal_mm: float | None = None
    most_frames: int = 60
    masks: Path | None = None
    keypoints: Path | None = None
    matting: Path | None = None
    detector: str = "mediapipe"
    hold_out: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        require_at_least("option frames", self.most_frames, LEAST_FRAMES)
        if self.height is not None:
            require_between("option height", self.height, 0.5, 2.6)
        if self.focal_mm is not None:
            require_between("option focal-mm", self.focal_mm, 5.0, 500.0)


@dataclass(frozen=True, eq=False)
class TurntableCapture:
    """A capture that was made, and how it was.

    Attributes:
        out: its folder.
        frames: number of its frames.
        found: poses, shape and camera, in the world of the search.
        lens: what was known of the lens.
        notes: what one camera left open, and faults of the inputs.
        held_out: numbers of the frames that are held out.
    """

    out: Path
    frames: int
    found: TurntableFit
    lens: Lens
    notes: tuple[str, ...]
    held_out: tuple[int, ...]

    def numbers(self) -> dict[str, Any]:
        """Return the figures of the command's summary."""
        residuals = {name: float(np.nanmedian(values)) for name, values in self.found.fit.residuals.items()}
        return {
            "frames": self.frames,
            "turned_degrees": round(self.found.turned, 1),
            "focal_px": float(self.found.camera.K[0, 0]),
            "focal_spread": self.found.focal_spread,
            "focal_told_by": self.lens.told_by,
            "height_m": round(self.found.stature, 3),
            **residuals,
        }


def make_turntable_capture(
    source: Path,
    out: Path,
    config: TurntableCaptureConfig | None = None,
    *,
    body: BodyModel | None = None,
    progress: ProgressCallback = ignore_progress,
) -> TurntableCapture:
    """Write a capture in our layout from photographs or a video of a person who turns before one camera.

    Args:
        source: folder of photographs in the order of the turn, video, or folder of a capture by one camera.
        out: a new or an empty folder; it is written whole or not at all.
        config: options.
        body: the model; None: the open body.
        progress: called with the running step and its share done.

    Raises:
        InputError: too few frames, frames of several sizes, no person in them, masks or keypoints of other frames.
        MissingExtraError: neither masks nor keypoints are given, and the extra `detect` is not installed.

    Example:
        >>> make_turntable_capture(Path("photos"), Path("anna"), TurntableCaptureConfig(height=1.68))  # doctest: +SKIP
    """
    config, body, source, out = config or TurntableCaptureConfig(), body or load_body(), Path(source), Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError("--out", expected="a new or an empty folder", received=str(out), remedy="name another folder")
    with turn_frames(source, config.most_frames) as (frames, given), atomic_folder(out) as root:
        if len(frames) < LEAST_FRAMES:
            raise InputError(
                f"turn {source}",
                expected=f"at least {LEAST_FRAMES} frames, better 8 and more",
                received=f"{len(frames)}",
            )
        held_out = held_out_frames(len(frames), config.hold_out)
        camera, lens = _write_images(root, frames, given, config, progress)
        write_plain_cameras_json(root / "cameras.json", {CAMERA: camera})
        atomic_write_text(root / "capture.json", json.dumps({"background": None}) + "\n")
        _write_masks(root, frames, given, config, progress)
        _write_keypoints(root, frames, given, config, progress)
        found, notes = _register(root, body, lens, config, held_out, progress)
        params, placed = leveled(found, body)
        write_plain_cameras_json(root / "cameras.json", {CAMERA: placed})
        params.save(root / "params" / "params.npz")
        made = TurntableCapture(out, len(frames), found, lens, notes, held_out)
        _describe(root, out.name, made)
    return made


def _write_images(
    root: Path,
    frames: list[TurnFrame],
    given: Capture | None,
    config: TurntableCaptureConfig,
    progress: ProgressCallback,
) -> tuple[Camera, Lens]:
    """Copy the photographs, upright, and return a level camera with the lens as far as it is known."""
    size: tuple[int, int] | None = None
    for row, frame in enumerate(frames):
        image = upright_image(frame.path)
        size = size or image.size
        if image.size != size:
            raise InputError(
                f"photograph {frame.path.name}",
                expected=f"{size[0]} x {size[1]} pixels, as the first",
                received=f"{image.size[0]} x {image.size[1]}",
                remedy="the camera has to stand still, with one zoom; do not crop photographs one by one",
            )
        suffix = frame.path.suffix.lower()
        jpeg = suffix in JPEG_SUFFIXES
        path = view_path(root, "image", CAMERA, row, suffix if jpeg or suffix == ".png" else ".png")
        # Files that need no rotation keep their bytes.
        if (jpeg or suffix == ".png") and not is_turned(frame.path):
            atomic_write_bytes(path, read_bytes(frame.path))
        elif jpeg:
            write_jpeg(path, np.asarray(image), quality=95)
        else:
            buffer = io.BytesIO()
            image.save(buffer, "PNG")
            atomic_write_bytes(path, buffer.getvalue())
        progress("frames", (row + 1) / len(frames))
    assert size is not None
    width, height = size
    # The level camera looks along -z from the origin; where it stands is found with the poses.
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    if given is not None:
        (calibrated,) = given.cameras.values()
        return Camera(calibrated.K, pose, width, height, name=CAMERA), Lens(
            float(calibrated.K[0, 0]), 0.0, "calibrated"
        )
    lens = lens_of(frames[0].path, size, config.focal_mm)
    K = np.array([[lens.pixels, 0, width / 2], [0, lens.pixels, height / 2], [0, 0, 1.0]])
    return Camera(K, pose, width, height, name=CAMERA), lens


def _write_masks(
    root: Path,
    frames: list[TurnFrame],
    given: Capture | None,
    config: TurntableCaptureConfig,
    progress: ProgressCallback,
) -> None:
    """Copy the masks that are given, or make them."""
    if config.masks is not None:
        files = files_of_frames(config.masks, frames, "masks")
        for row, path in files.items():
            write_gray_png(view_path(root, "mask", CAMERA, row, ".png"), np.asarray(read_alpha(path)))
        return
    if given is not None and given.presence("mask").any():
        (camera,) = given.cameras
        for row, frame in enumerate(frames):
            mask = given.mask(camera, int(frame.number or 0))
            if mask is not None:
                write_gray_png(view_path(root, "mask", CAMERA, row, ".png"), mask)
        return
    capture = open_capture(root, cache_bytes=0)
    if config.matting is not None:
        model: Any = MattingModel(config.matting)
    else:
        from smplxpp.detect.mediapipe_detector import PersonSegmenter

        model = PersonSegmenter()
    for done, _ in enumerate(write_mattes(capture, model, root / "masks"), start=1):
        progress("masks", done / len(frames))


def _write_keypoints(
    root: Path,
    frames: list[TurnFrame],
    given: Capture | None,
    config: TurntableCaptureConfig,
    progress: ProgressCallback,
) -> None:
    """Copy the keypoints that are given, or detect them."""
    target = root / "keypoints" / f"{CAMERA}.npz"
    if config.keypoints is not None:
        write_keypoints(target, keypoints_of_frames(read_keypoints(config.keypoints), frames, str(config.keypoints)))
        return
    if given is not None:
        (camera,) = given.cameras
        found = given.keypoints(camera)
        if found is not None:
            write_keypoints(target, keypoints_of_frames(found, frames, f"capture {given.name}"))
            return
    detect_keypoints(
        open_capture(root, cache_bytes=0), load_detector(config.detector), target.parent, progress=progress
    )


def _register(
    root: Path,
    body: BodyModel,
    lens: Lens,
    config: TurntableCaptureConfig,
    held_out: tuple[int, ...],
    progress: ProgressCallback,
) -> tuple[TurntableFit, tuple[str, ...]]:
    """Fit poses, shape and camera to keypoints and masks."""
    capture = open_capture(root)
    keypoints = capture.keypoints(CAMERA)
    frames = capture.frames
    observed = Observations(
        frames=frames,
        cameras=capture.cameras,
        keypoints={} if keypoints is None else {CAMERA: keypoints},
        mask=capture.mask,
        shape_frames=tuple(frame for frame in frames if frame not in held_out),
    )
    options = TurntableConfig(stature=config.height, focal_spread=lens.spread)
    found = register_turntable(body, observed, options, progress=progress)
    return found, (*turn_notes(found, body, stature=config.height), *found.fit.notes)


def held_out_frames(count: int, chosen: tuple[int, ...] = ()) -> tuple[int, ...]:
    """Return the frames that are held out of a turn of a number of frames: the chosen, else every tenth of 20 and more.

    Raises:
        InputError: chosen frames that the turn does not have, the reference, or a number that leaves too few.
    """
    if chosen:
        if not set(chosen) <= set(range(1, count)) or count - len(set(chosen)) < LEAST_FRAMES:
            raise InputError(
                "option hold-out",
                expected=f"numbers of frames, 1 to {count - 1}, of which {LEAST_FRAMES} are left with frame 0",
                received=" ".join(map(str, chosen)),
            )
        return tuple(sorted(set(chosen)))
    if count < _HOLD_OUT_FROM:
        return ()
    return tuple(range(_HOLD_OUT_EVERY // 2, count, _HOLD_OUT_EVERY))


def _describe(root: Path, name: str, made: TurntableCapture) -> None:
    """Write capture.json, which says of what kind the capture is and what is not known."""
    turn_seconds = 8.0  # in which players show a turn; photographs have no rate, and faster turns make a person spin
    held_out = made.held_out
    train = [frame for frame in range(made.frames) if frame not in held_out]
    content = {
        "name": name,
        "kind": TURNTABLE,
        "background": None,
        "fps": made.frames / turn_seconds,
        "inputs": {"parameters": "tracked"},
        "train_frames": [[frame, frame] for frame in train],
        **({"novel_pose_frames": [[frame, frame] for frame in held_out]} if held_out else {}),
        "found": {**made.numbers(), "notes": list(made.notes)},
    }
    atomic_write_text(root / "capture.json", json.dumps(jsonable(content), indent=1) + "\n")
