"""`smplxpp capture masks`: who is in a capture's images, as mattes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pipelines.commands.options import OptionalPath, OptionalText
from smplxpp.core.errors import InputError

if TYPE_CHECKING:
    from pipelines.captures.masks import Matter
    from smplxpp.capture import Capture


@dataclass(frozen=True)
class CaptureMasks:
    """Options of the command. Give one of --matting, --plates and --mediapipe."""

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of the capture, in any layout of docs/captures.md."""
    out: Path
    """Folder to write CAM/CAM_maskFFFFFF.png into, for --masks of the other commands, or `masks` of the capture itself;
    those that stand there are kept."""
    matting: OptionalPath = None
    """ONNX model of your own (BiRefNet, ISNet, ...): the best that there is."""
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
        """Write the masks; returns how many stand."""
        from pipelines.captures.masks import write_masks
        from pipelines.commands.capture import selected_frames
        from pipelines.commands.progress import shared_progress
        from pipelines.runs.folders import keep_out_of_capture
        from smplxpp.capture import open_capture
        from smplxpp.core.files.paths import same_place

        if not same_place(self.out, self.capture / "masks"):
            keep_out_of_capture(self.out, self.capture)
        capture = open_capture(self.capture, cache_bytes=0)
        names = None if self.cameras is None else tuple(name.strip() for name in self.cameras.split(","))
        frames = selected_frames(self.frames, capture)
        views = capture.views(names, frames)
        if not views:
            raise InputError(f"capture {capture.name}", expected="images to make masks of", received="none")
        cameras = tuple(dict.fromkeys(camera for camera, _ in views))
        matter_of, identity = self._matters(capture, cameras)
        written = write_masks(capture, matter_of, self.out, identity=identity, cameras=cameras, frames=frames)
        with shared_progress(enabled=not self.json) as progress:
            for done, _ in enumerate(written, start=1):
                progress("masks", done / len(views))
        return {"out": str(self.out), "masks": len(views), "cameras": list(cameras)}

    def _matters(self, capture: Capture, cameras: tuple[str, ...]) -> tuple[Callable[[str], Matter], str]:
        """Who makes the mattes of a camera, and what to call them."""
        given = [name for name in ("matting", "plates", "mediapipe") if getattr(self, name)]
        if len(given) != 1:
            raise InputError(
                "options", expected="one of --matting, --plates and --mediapipe", received=" and ".join(given) or "none"
            )
        if self.plates is not None:
            from pipelines.captures.masks import Plates

            plates = Plates(self.plates, cameras)
            return plates.of_camera, plates.identity
        matter: Matter
        if self.matting is not None:
            from pipelines.runs.code import sha256_file
            from smplxpp.capture.masks import MattingModel

            matter, identity = MattingModel(self.matting), f"matting model {sha256_file(self.matting)}"
        else:
            from smplxpp.detect.person_mask import PersonSegmenter

            matter = segmenter = PersonSegmenter()
            identity = segmenter.identity
        return lambda camera: matter, identity
