"""`smplxpp keypoints convert`: keypoints of any known detector to ours."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from pipelines.commands.options import OptionalInt, OptionalPath, OptionalText
from smplxpp.core.errors import InputError

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
    """Layout of the input; auto tells it by the keys. OpenPose's BODY_25B has to be named: openpose-25b."""
    person: OptionalInt = None
    """Id of the person in the files, or else the place in their lists; by default the surest of each frame."""
    first_frame: OptionalInt = None
    """Number of the first frame, where the files count otherwise than the capture (mmpose counts videos from 1)."""
    capture: OptionalPath = None
    """Capture whose cameras are looked for, and whose images' sizes are taken for shares of them (MediaPipe)."""
    size: OptionalText = None
    """WIDTHxHEIGHT of all images, instead."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Convert; returns what was found of each camera."""
        from smplxpp.capture import open_capture
        from smplxpp.capture.keypoint_files import KeypointFiles, KeypointOptions, find_places
        from smplxpp.capture.writers.keypoints import write_keypoints

        if not self.input.is_dir():
            raise InputError("keypoints", expected="an existing folder", received=str(self.input))
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
            seen = float((found.confidence > 0).mean()) if found.confidence.size else 0.0
            summary[name] = {"frames": len(found.frames), "points": len(found.names), "seen": seen}
            log.info(
                "%s: %d frames, %d points, %.0f %% of them seen", name, *list(summary[name].values())[:2], 100 * seen
            )
        return {"input": str(self.input), "out": str(self.out), "cameras": summary}


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
