"""`smplxpp synth` and `smplxpp capture turntable`: captures of a synthetic person, and of one who turns."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn

from pipelines.commands.options import OptionalFloat, OptionalInt, OptionalPath, OptionalText
from smplxpp.core import InputError, require_at_least, require_between, require_choice
from smplxpp.core.files.panorama_file import read_panorama
from smplxpp.people.fixture_person import CLOTHES
from smplxpp.raster.soft_light import Environment
from smplxpp.synth.config import SynthConfig, motion_kind
from smplxpp.synth.write_capture import make_capture

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Synth:
    """Options of the command."""

    out: Path
    """Folder to write; it must not exist, or be empty."""
    motion: str = "turning"
    """Motion: turning (gestures, a turn with steps, arms overhead), talking (standing, with gestures) or turntable (a
    turn on the spot before one camera)."""
    frames: int = 24
    """Length of the motion; the last fifth of the frames is held out."""
    cameras: OptionalInt = None
    """Number of cameras, 12 (talking: 8). From four on two are close-ups of the face, and some others are held out."""
    size: int = 640
    """Height of body images in pixels; close-ups are square and 3/4 as high."""
    width: OptionalInt = None
    """Width of body images in pixels, in eights; 4/5 of the height (talking: 3/5)."""
    clothes: OptionalText = None
    """Clothes below the shirt: skirt (loose) or trousers (tight); by default a skirt (talking: trousers)."""
    skirt_pattern: OptionalText = None
    """Pattern of a skirt: plaid (default), stripes (vertical), hoops (horizontal), dots or plain."""
    skirt_length: OptionalText = None
    """Length of a skirt: knee (default), or calf (its hem halfway from the knees to the ankles)."""
    outside: float = 0.0
    """Millimetres (root mean square) of offsets of her body that no shape of the body model has, as real people do."""
    seed: int = 0
    """Seed of the motion, the cameras and all noise."""
    fps: float = 10.0
    """Frames a second."""
    layout: Literal["simple", "actorshq"] = "simple"
    """Ours with everything, or images, masks and cameras in ActorsHQ's folders."""
    quality: int = 95
    """Quality of JPEG images."""
    truth_step: OptionalInt = None
    """Truth meshes of every n-th frame, of all (talking: 2)."""
    normals_step: OptionalInt = None
    """Normal maps of every n-th frame, of all (talking: 4)."""
    scan_faces: int = 80_000
    """Size of the reference frame's scan; 0 makes none."""
    environment: OptionalPath = None
    """Light of this panorama (.hdr, .exr) in the place of the stage's, with the shadows that she casts: with
    the same seed and options the same performance in a second light."""
    environment_turn: float = 0.0
    """Rotation of that light about the vertical, degrees."""
    exposure: OptionalFloat = None
    """Factor on that light; by default it is as bright in the mean as the stage."""
    person: Path = FIXTURE
    """The person's folder, with geometry/topology.npz."""
    json: bool = False
    """Print the figures as JSON."""

    def run(self) -> dict:
        """Make the capture; returns the figures about it."""
        if self.out.exists() and (not self.out.is_dir() or any(self.out.iterdir())):
            raise InputError(
                "--out",
                expected="a new or an empty folder",
                received=str(self.out),
                remedy="name another, or delete it",
            )
        # Check all options and read the panorama before rendering starts.
        config, environment = self._config(), self._environment()
        console = Console(stderr=True)
        columns = (TextColumn("{task.description:<8}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
        with Progress(*columns, console=console) as bars:
            tasks: dict[str, TaskID] = {}

            def show(what: str, share: float) -> None:
                if what not in tasks:
                    tasks[what] = bars.add_task(what, total=1.0)
                bars.update(tasks[what], completed=share)

            topology = self.person / "geometry" / "topology.npz"
            checks = make_capture(self.out, topology, config, environment=environment, progress=show)
        console.print(
            f"{self.out}: {config.motion}, {config.cameras} cameras, {config.frames} frames",
            highlight=False,
            soft_wrap=True,
            markup=False,
        )
        return {"out": str(self.out), "cameras": config.cameras, "frames": config.frames, "checks": checks}

    def _environment(self) -> Environment | None:
        if self.environment is None:
            if self.environment_turn or self.exposure is not None:
                raise InputError(
                    "--environment", expected="a panorama, for --environment-turn and --exposure", received="none"
                )
            return None
        panorama = read_panorama(self.environment)
        return Environment(panorama, self.environment.stem, self.environment_turn, self.exposure)

    def _config(self) -> SynthConfig:
        """Make the configuration; the kind of motion gives the defaults of omitted options."""
        # The motion determines sensible numbers of cameras, truth meshes and clothes.
        kind = motion_kind(self.motion)
        require_between("--outside", self.outside, 0.0, 30.0)
        require_at_least("--size", self.size, 16)
        if self.width is not None:
            require_at_least("--width", self.width, 8)
        clothes = kind.clothes if self.clothes is None else self.clothes
        require_choice("--clothes", clothes, CLOTHES)
        for option, value in (("--skirt-pattern", self.skirt_pattern), ("--skirt-length", self.skirt_length)):
            if value is not None and clothes != "skirt":
                raise InputError(option, expected="clothes with a skirt", received=f"--clothes {clothes}")
        return SynthConfig(
            cameras=kind.cameras if self.cameras is None else self.cameras,
            frames=self.frames,
            size=self.size,
            seed=self.seed,
            fps=self.fps,
            layout=self.layout,
            quality=self.quality,
            truth_step=kind.truth_step if self.truth_step is None else self.truth_step,
            normals_step=kind.normals_step if self.normals_step is None else self.normals_step,
            scan_faces=self.scan_faces,
            motion=self.motion,
            clothes=clothes,
            outside=1e-3 * self.outside,
            skirt_pattern=self.skirt_pattern or SynthConfig.skirt_pattern,
            skirt_length=self.skirt_length or SynthConfig.skirt_length,
            aspect=kind.aspect if self.width is None else self.width / self.size,
            texel=kind.texel,
        )


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
