"""`smplxpp keypoints convert`, `keypoints detect` and `capture masks`: what detectors find in a capture's images."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from pipelines.commands.options import OptionalInt, OptionalPath, OptionalText, listed_names, selected_frames
from smplxpp.core.errors import InputError

if TYPE_CHECKING:
    from smplxpp.build.capture_masks import MatteModel
    from smplxpp.capture import Capture


log = logging.getLogger(__name__)
FormatName = Literal["auto", "simple", "openpose", "openpose-25b", "easymocap", "mmpose", "coco", "mediapipe"]


@dataclass(frozen=True)
class KeypointsConvert:
    """Options of the command."""

    input: tyro.conf.Positional[Path]
    """Folder with a file or a folder for each camera."""
    out: Path
    """Folder to write CAM.npz into: `keypoints/` of a capture in our layout, or what `--keypoints` takes."""
    format: FormatName = "auto"
    """Layout of the input; auto tells it by the keys. OpenPose's BODY_25B is recognised by its lengths."""
    person: OptionalInt = None
    """Id of the person in the files, or else the place in their lists; by default the most confident of each frame."""
    first_frame: OptionalInt = None
    """Number of the first frame, where the files count otherwise than the capture (mmpose counts videos from 1)."""
    capture: OptionalPath = None
    """Capture whose cameras are looked for, and whose images' sizes are taken for shares of them (MediaPipe)."""
    size: OptionalText = None
    """WIDTHxHEIGHT of all images, instead."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Convert the files and return the number of frames and points for each camera."""
        from smplxpp.capture import open_capture
        from smplxpp.capture.keypoint_files import KeypointOptions
        from smplxpp.capture.keypoints import KeypointFiles, find_places
        from smplxpp.capture.writers import write_keypoints

        if not self.input.is_dir():
            raise InputError("keypoints", expected="an existing folder", received=str(self.input))
        # The capture gives names of cameras, and image sizes for coordinates that are shares of them.
        options = KeypointOptions(self.format, self.person, _size(self.size), self.first_frame)
        cameras = None if self.capture is None else open_capture(self.capture).recording.cameras
        places = find_places(self.input, None if cameras is None else cameras)
        sizes = {name: (camera.width, camera.height) for name, camera in (cameras or {}).items()}
        files = KeypointFiles(places, options, sizes)
        if not places:
            raise InputError(
                f"keypoints {self.input}",
                expected="a file or a folder for each camera" + ("" if cameras is None else f": {', '.join(cameras)}"),
                received=", ".join(sorted(path.name for path in self.input.iterdir())[:6]) or "nothing",
            )
        read = {name: files.read(name) for name in places}  # all, before anything is written
        summary = {}
        for name, found in read.items():
            assert found is not None  # it has a place
            write_keypoints(self.out / f"{name}.npz", found)
            # A confidence of 0 marks a point that the detector did not find.
            seen = float((found.confidence > 0).mean()) if found.confidence.size else 0.0
            summary[name] = {"frames": len(found.frames), "points": len(found.names), "seen": seen}
            log.info(
                "%s: %d frames, %d points, %.0f %% of them seen", name, *list(summary[name].values())[:2], 100 * seen
            )
        return {"input": str(self.input), "out": str(self.out), "cameras": summary}


@dataclass(frozen=True)
class KeypointsDetect:
    """Options of the command."""

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of the capture, in any layout of docs/captures.md."""
    out: Path
    """Folder to write CAM.npz into, for --keypoints of the other commands, or `keypoints` of the capture itself; what
    stands there of the same images and the same detector is kept."""
    detector: str = "mediapipe"
    """mediapipe (extra `detect`), or the path of your own model.onnx (docs/detectors.md)."""
    cameras: OptionalText = None
    """Names of cameras with commas between, or all; by default those that training may see, without the held-out."""
    frames: OptionalText = None
    """Frames to look at: numbers and ranges START:STOP:STEP with commas between; by default all."""
    masks: OptionalPath = None
    """Folder of mattes to take instead of the capture's own masks; the person is looked for in the mask's box."""
    sheet: OptionalPath = None
    """Picture to write (.png or .jpg): a photograph of each camera with its points."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Detect keypoints and return the number of frames for each camera."""
        from pipelines.commands.terminal import shared_progress
        from pipelines.runs.folders import keep_out_of_capture
        from smplxpp.capture import open_capture
        from smplxpp.core.files.atomic import atomic_write_bytes
        from smplxpp.core.files.paths import same_place
        from smplxpp.detect import load_detector
        from smplxpp.figures import encode_jpeg, encode_png
        from smplxpp.footage.keypoints import detect_keypoints, detection_notes, detection_sheet

        # `keypoints` of the capture itself is allowed, any other place inside the capture is not.
        if not same_place(self.out, self.capture / "keypoints"):
            keep_out_of_capture(self.out, self.capture)
        capture = open_capture(self.capture, masks=self.masks, cache_bytes=0)
        names = listed_names(self.cameras)
        frames = selected_frames(self.frames, capture)
        # Check the output name before the detector is loaded.
        if self.sheet is not None and self.sheet.suffix.lower() not in (".png", ".jpg"):
            raise InputError("--sheet", expected="the name of a .png or .jpg", received=str(self.sheet))
        detector = load_detector(self.detector)
        # `all` includes held-out cameras, whose keypoints serve measuring only.
        with shared_progress(enabled=not self.json) as progress:
            found = detect_keypoints(
                capture,
                detector,
                self.out,
                cameras=tuple(capture.cameras) if names == ("all",) else names,
                frames=frames,
                progress=progress,
            )
        # The contact sheet shows one frame of each camera with the detected points.
        if self.sheet is not None:
            encode = encode_png if self.sheet.suffix.lower() == ".png" else encode_jpeg
            atomic_write_bytes(self.sheet, encode(detection_sheet(capture, found)))
        summary = {}
        for name, one in found.items():
            seen = float((one.people > 0).mean())
            summary[name] = {"frames": len(one.people), "with_a_person": seen, "detected_now": one.detected}
            log.info("%s: %d frames, a person in %.0f %% of them", name, len(one.people), 100 * seen)
        notes = detection_notes(found, capture.splits.novel_view_cameras)
        for note in notes:
            log.warning(note)
        return {"out": str(self.out), "detector": self.detector, "cameras": summary, "notes": notes}


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    try:
        width, height = (int(part) for part in text.lower().split("x"))
        if min(width, height) < 1:
            raise ValueError
    except ValueError:
        raise InputError("--size", expected="WIDTHxHEIGHT", received=text) from None
    return width, height


@dataclass(frozen=True)
class CaptureMasks:
    """Options of `smplxpp capture masks`. Give one of --matting, --plates and --mediapipe."""

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of the capture, in any layout of docs/captures.md."""
    out: Path
    """Folder to write CAM/CAM_maskFFFFFF.png into, for --masks of the other commands, or `masks` of the capture itself;
    existing ones are kept."""
    matting: OptionalPath = None
    """ONNX model of your own (BiRefNet, ISNet, ...), the best choice."""
    plates: OptionalPath = None
    """Folder with photographs of the empty rig: CAM.png, or a folder for each camera with one or several."""
    mediapipe: bool = False
    """MediaPipe's segmentation (extra `detect`): rough, without any file of yours."""
    cameras: OptionalText = None
    """Names of cameras with commas between; by default all."""
    frames: OptionalText = None
    """Frames: numbers and ranges START:STOP:STEP with commas between; by default all."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Write the masks and return how many there are."""
        from pipelines.commands.terminal import shared_progress
        from pipelines.runs.folders import keep_out_of_capture
        from smplxpp.build.capture_masks import write_masks
        from smplxpp.capture import open_capture
        from smplxpp.core.files.paths import same_place

        # `masks` of the capture itself is allowed, any other place inside the capture is not.
        if not same_place(self.out, self.capture / "masks"):
            keep_out_of_capture(self.out, self.capture)
        capture = open_capture(self.capture, cache_bytes=0)
        names = listed_names(self.cameras)
        frames = selected_frames(self.frames, capture)
        # Look for images before the model is loaded, which takes seconds.
        views = capture.views(names, frames)
        if not views:
            raise InputError(f"capture {capture.name}", expected="images to make masks of", received="none")
        cameras = tuple(dict.fromkeys(camera for camera, _ in views))
        model_of, identity = self._matte_models(capture, cameras)
        written = write_masks(capture, model_of, self.out, identity=identity, cameras=cameras, frames=frames)
        with shared_progress(enabled=not self.json) as progress:
            for done, _ in enumerate(written, start=1):
                progress("masks", done / len(views))
        return {"out": str(self.out), "masks": len(views), "cameras": list(cameras)}

    def _matte_models(self, capture: Capture, cameras: tuple[str, ...]) -> tuple[Callable[[str], MatteModel], str]:
        """Return the chosen matte model of each camera and its identity for the record."""
        given = [name for name in ("matting", "plates", "mediapipe") if getattr(self, name)]
        if len(given) != 1:
            raise InputError(
                "options", expected="one of --matting, --plates and --mediapipe", received=" and ".join(given) or "none"
            )
        # The identity goes into the folder's record, because masks of two origins must not mix in one folder. Plates
        # differ by camera; the other two models are the same for all.
        if self.plates is not None:
            from smplxpp.build.capture_masks import Plates

            plates = Plates(self.plates, cameras)
            return plates.of_camera, plates.identity
        model: MatteModel
        if self.matting is not None:
            from pipelines.runs.code import sha256_file
            from smplxpp.capture.masks import MattingModel

            model, identity = MattingModel(self.matting), f"matting model {sha256_file(self.matting)}"
        else:
            from smplxpp.detect.mediapipe_detector import PersonSegmenter

            model = segmenter = PersonSegmenter()
            identity = segmenter.identity
        return lambda camera: model, identity
