"""`smplxpp capture masks`: masks of a capture's images by a matting model, empty plates or MediaPipe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pipelines.commands.options import OptionalPath, OptionalText, listed_names, selected_frames
from smplxpp.core.errors import InputError

if TYPE_CHECKING:
    from smplxpp.build.capture_masks import MatteModel
    from smplxpp.capture import Capture


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
