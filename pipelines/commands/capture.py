"""`smplxpp capture check`, `smplxpp capture convert` and `smplxpp capture degrade`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from pipelines.commands.options import (
    OptionalInt,
    OptionalPath,
    OptionalText,
    frame_numbers,
    listed_names,
    selected_frames,
)
from pipelines.commands.terminal import print_notes, print_paths
from smplxpp.core.errors import InputError

if TYPE_CHECKING:
    from smplxpp.capture import Capture
    from smplxpp.capture.convert import Conversion


FormatName = Literal[
    "auto", "simple", "actorshq", "talkbody4d", "avatarrex", "thuman4", "4ddress", "neus2", "easymocap", "colmap", "rig"
]


@dataclass(frozen=True)
class CaptureCheckCommand:
    """Options of `smplxpp capture check`."""

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of the capture, in any layout of docs/captures.md."""
    format: FormatName = "auto"
    """Layout; auto detects it from the files."""
    frames: OptionalText = None
    """Frames whose images are opened: all, or numbers and ranges START:STOP:STEP with commas between. By default as
    many, evenly spread, as make 2,000 images."""
    masks: OptionalPath = None
    """Folder of mattes to check instead of the capture's own masks."""
    params: OptionalPath = None
    """Body parameters to check instead of the capture's own."""
    protocol: OptionalText = None
    """Protocol of the capture, whose parameters, labels and normals are checked."""
    body: OptionalPath = None
    """Body model file that the parameters are for; the open body by default."""
    out: OptionalPath = None
    """Folder for report.html, contact_sheet.png and check.json."""
    json: bool = False
    """Print the findings and figures as JSON."""

    def run(self) -> dict:
        """Check; exit status 1 if something has to be corrected."""
        from pipelines.commands.terminal import shared_progress
        from pipelines.report.capture_check import check_as_dict, print_check, write_check_report
        from pipelines.runs.folders import keep_out_of_capture
        from smplxpp.body import load_body
        from smplxpp.capture import open_capture
        from smplxpp.capture.check import CheckConfig

        # A report inside the capture would be read as one of its files.
        if self.out is not None:
            keep_out_of_capture(self.out, self.capture)
        body = load_body(self.body)
        # The command's folders replace the capture's own files, so that new masks can be checked before they are
        # copied.
        capture = open_capture(
            self.capture,
            format=_reader(self.format),
            masks=self.masks,
            params=self.params,
            body=body,
            protocol=self.protocol,
        )
        config = CheckConfig(frames=selected_frames(self.frames, capture))
        # Findings go to the terminal, to the page and, with --json, to the answer.
        with shared_progress(enabled=not self.json) as progress:
            check = capture.check(body, config, progress=progress)
        if not self.json:
            print_check(check, Console())
        report = None if self.out is None else write_check_report(check, self.out)
        if not self.json:
            print_paths({"report": report}, Console())
        paths = {"report": None if report is None else str(report)}
        return {**check_as_dict(check), **paths, "exit_status": int(check.failed)}


@dataclass(frozen=True)
class CaptureConvertCommand:
    """Options of `smplxpp capture convert`."""

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of the capture, in any layout of docs/captures.md."""
    out: Path
    """New folder to write; the same command continues with one that was interrupted."""
    layout: Literal["simple", "actorshq"] = "simple"
    """Ours, or ActorsHQ's: images on black, masks, cameras, parameters."""
    format: FormatName = "auto"
    """Layout of the source; auto detects it from the files."""
    scale: float = 1.0
    """Resolution as a factor."""
    frames: OptionalText = None
    """Frames to keep: numbers and ranges START:STOP:STEP with commas between; by default all."""
    cameras: OptionalText = None
    """Names of the cameras to keep, with commas between; by default all."""
    masks: OptionalPath = None
    """Folder of mattes to take instead of the capture's own masks."""
    keypoints: OptionalPath = None
    """Folder of keypoints of any detector (docs/captures.md) to take instead of the capture's own."""
    person: OptionalInt = None
    """Id in the keypoint files of the person to take, in each view by itself."""
    subject: OptionalInt = None
    """Person to take where several are in view, by the number that a note gives; by default the first: whom most views
    agree on, large in the pictures and near the middle."""
    calibration: OptionalPath = None
    """Calibration file of a rig (formats: docs/captures.md), or a folder with one; by default looked for in DIR and
    beside it."""
    units: OptionalText = None
    """Unit of the calibration: m, cm, mm or inch; by default that of its format, else guessed by the distances."""
    up: OptionalText = None
    """Axis of the calibration's world that points up: x, y, z, -x, -y or -z; by default that of its format, else what
    the pictures say."""
    offset: OptionalText = None
    """Seconds at which cameras of a rig of videos started, CAM=SECONDS with commas between; others started at 0."""
    sync: Literal["none", "sound", "motion"] = "none"
    """Find these offsets by the videos' sound, or by the motion in them."""
    matting: OptionalPath = None
    """ONNX model of your own that makes the mattes. They go into the folder of --masks; existing ones are kept."""
    params: OptionalPath = None
    """Body parameters to take instead of the capture's own."""
    body: OptionalPath = None
    """Body model file of the parameters, for layouts that rotate it about the origin; the open body by default."""
    quality: int = 95
    """Quality of JPEG images that cannot be copied."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Convert; exit status 1 if something had to be left out."""
        from pipelines.commands.terminal import shared_progress
        from smplxpp.body import load_body
        from smplxpp.capture import open_capture
        from smplxpp.capture.convert import ConvertConfig, convert_capture
        from smplxpp.capture.readers.common import RigOptions
        from smplxpp.capture.readers.rig import find_videos

        # Make the mattes first: the capture is opened with them.
        body = None if self.body is None else load_body(self.body)
        if self.matting is not None:
            self._matte(self.matting)
        # No image cache: every image is read once.
        capture = open_capture(
            self.capture,
            format=_reader(self.format),
            masks=self.masks,
            params=self.params,
            keypoints=self.keypoints,
            person=self.person,
            subject=self.subject,
            rig=RigOptions(self.calibration, self.units, self.up),
            body=body,
            cache_bytes=0,
        )
        videos = find_videos(capture.root, list(capture.cameras)) if capture.format == "rig" else {}
        if videos and not capture.views():
            return self._decode(capture, videos)
        if self.offset is not None or self.sync != "none":
            raise InputError("--offset and --sync", expected="a rig of videos", received=repr(capture))
        config = ConvertConfig(
            layout=self.layout,
            scale=self.scale,
            frames=selected_frames(self.frames, capture),
            cameras=listed_names(self.cameras),
            quality=self.quality,
        )
        # The same command resumes an interrupted conversion, so that files of the first call count as kept.
        with shared_progress(enabled=not self.json) as progress:
            done = convert_capture(capture, self.out, config, progress=progress)
        self._print(capture, done)
        return {**vars(done), "exit_status": int(bool(done.left_out))}

    def _decode(self, capture: Capture, videos: Mapping[str, Path]) -> dict:
        """Decode the videos of a rig; its notes are no reason for another exit status."""
        from pipelines.commands.terminal import shared_progress
        from smplxpp.capture.convert_videos import VideoConfig, convert_videos

        for option, value, default in (("--layout", self.layout, "simple"), ("--scale", self.scale, 1.0)):
            if value != default:
                raise InputError(
                    option,
                    expected=f"{default} for videos",
                    received=str(value),
                    remedy="convert the result again with other options",
                )
        config = VideoConfig(
            offsets=_offsets(self.offset),
            sync=self.sync,
            frames=frame_numbers(self.frames),
            cameras=listed_names(self.cameras),
            quality=self.quality,
        )
        with shared_progress(enabled=not self.json) as progress:
            done = convert_videos(capture, videos, self.out, config, progress=progress)
        self._print(capture, done)
        return vars(done)

    def _print(self, capture: Capture, done: Conversion) -> None:
        """Print what was written, and what is worth knowing."""
        if self.json:
            return
        console = Console()
        print_notes(capture.keypoint_notes(), console)
        # What was guessed of a rig's calibration; a conversion of videos has it among its notes.
        if capture.format == "rig":
            known = {*done.left_out, *(problem.message for problem in capture.problems)}
            print_notes(sorted(note for note in known if "videos, which" not in note), console)
        else:
            print_notes(done.left_out, console, title="left out")
        files = f"{done.copied} files copied, {done.encoded} encoded, {done.kept} there already"
        console.print(f"{self.out}: {done.views} views; {files}", soft_wrap=True, highlight=False, markup=False)

    def _matte(self, model_file: Path) -> None:
        """Run the model over every image that has no matte yet."""
        from pipelines.commands.terminal import shared_progress
        from smplxpp.capture import open_capture
        from smplxpp.capture.masks import MattingModel, write_mattes

        if self.masks is None:
            raise InputError("--matting", expected="--masks FOLDER for the mattes", received="no folder")
        capture = open_capture(self.capture, format=_reader(self.format), cache_bytes=0)
        model, total = MattingModel(model_file), len(capture.views())
        with shared_progress(enabled=not self.json) as progress:
            for done, _ in enumerate(write_mattes(capture, model, self.masks), start=1):
                progress("mattes", done / total)


def _offsets(text: str | None) -> dict[str, float]:
    """Return the offsets that a text names: `cam1=0.2,cam2=-1`.

    Raises:
        InputError: not understood.
    """
    out: dict[str, float] = {}
    for part in text.split(",") if text else ():
        name, _, seconds = part.strip().rpartition("=")
        try:
            out[name.strip()] = float(seconds)
            if not name.strip() or not abs(out[name.strip()]) < 1e6:
                raise ValueError
        except ValueError:
            raise InputError("--offset", expected="CAM=SECONDS with commas between", received=part) from None
    return out


def _reader(format: FormatName) -> str | None:
    """Return the name of a reader; None where the files tell it."""
    return None if format == "auto" else format


@dataclass(frozen=True)
class CaptureDegradeCommand:
    """Options of `smplxpp capture degrade`."""

    capture: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of a capture in our layout whose parameters and label maps are exact."""
    out: Path
    """New folder to write."""
    seed: int = 0
    """Seed of all errors."""
    copy: bool = False
    """Copy the old capture's files; by default they are linked."""
    rig: int = 0
    """Cameras of a synthetic ring for the keypoints, where the capture has no cameras."""
    size: int = 640
    """Height in pixels of the ring's images."""
    body: OptionalPath = None
    """Body model file of the parameters; the open body by default."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Degrade the capture and return a summary."""
        from smplxpp.body import load_body
        from smplxpp.synth.degrade import DegradeConfig, degrade_capture

        config = DegradeConfig(seed=self.seed, copy=self.copy, rig=self.rig, size=self.size)
        body = None if self.body is None else load_body(self.body)
        made = degrade_capture(self.capture, self.out, config, body=body)
        if not self.json:
            console = Console()
            print_notes(made.left_out, console, title="left out", most=len(made.left_out))
            labels = f"{100 * made.labels_wrong:.1f} % of the labels wrong"
            line = f"{made.out}: {made.frames} frames, keypoints of {made.cameras} cameras, {labels}"
            console.print(line, soft_wrap=True, highlight=False)
            # The exact inputs are there, too, and are what a build takes by default.
            step = f"next    smplxpp build RUN --capture {made.out} --protocol tracked"
            console.print(step, soft_wrap=True, highlight=False, markup=False)
        return {**vars(made), "out": str(made.out)}
