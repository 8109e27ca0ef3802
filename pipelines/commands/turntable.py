"""`smplxpp capture turntable`: photographs or a video of a person who turns in; a capture with camera and poses out."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pipelines.commands.options import OptionalFloat, OptionalPath

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CaptureTurntable:
    """Options of `smplxpp capture turntable`.

    The person stands before a camera that does not move, arms away from the body, and turns once on the spot.
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS_OR_VIDEO")]
    """Folder of photographs, sorted by name in the order of the turn; a video; or a capture by one camera."""
    out: Path
    """New folder to write."""
    height: OptionalFloat = None
    """Height of the person with shoes, metres. One camera does not see it: without, it is a guess within 4 percent."""
    focal_mm: OptionalFloat = None
    """Focal length, millimetres of 35 mm film (phones: 24 to 28, filming up to 30). By default that of the photograph's
    Exif record; without one it is estimated."""
    frames: int = 60
    """Number of frames to take, evenly spread."""
    masks: OptionalPath = None
    """Folder of masks with the frames' numbers in their names; by default they are made."""
    keypoints: OptionalPath = None
    """Keypoints of any detector (docs/captures.md); by default they are detected."""
    matting: OptionalPath = None
    """ONNX model of your own that makes the masks; by default MediaPipe's rough segmentation (extra `detect`)."""
    detector: str = "mediapipe"
    """mediapipe (extra `detect`), or the path of your own pose model.onnx."""
    hold_out: tuple[int, ...] = ()
    """Numbers of the frames, from 0, to keep from shape and training, to measure on. By default every tenth of 20 and
    more."""
    body: OptionalPath = None
    """SMPL-X-layout body file; the open body by default."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Make the capture and return its figures."""
        from pipelines.commands.terminal import shared_progress
        from smplxpp.body import load_body
        from smplxpp.footage.turntable import TurntableCaptureConfig, make_turntable_capture

        config = TurntableCaptureConfig(
            height=self.height,
            focal_mm=self.focal_mm,
            most_frames=self.frames,
            masks=self.masks,
            keypoints=self.keypoints,
            matting=self.matting,
            detector=self.detector,
            hold_out=self.hold_out,
        )
        with shared_progress(enabled=not self.json) as progress:
            made = make_turntable_capture(self.source, self.out, config, body=load_body(self.body), progress=progress)
        numbers = made.numbers()
        log.info(
            "%s: %d frames, turned by %.0f degrees; keypoints %.1f px, contours %.1f px off; focal length %.0f px (%s)",
            made.out,
            made.frames,
            numbers["turned_degrees"],
            numbers["keypoints_px"],
            numbers.get("silhouette_px", float("nan")),
            numbers["focal_px"],
            numbers["focal_told_by"],
        )
        for note in made.notes:
            log.warning(note)
        return {"out": str(made.out), **numbers, "notes": list(made.notes)}
