"""Settings of a synthetic capture, and the motions by name with the defaults of their captures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from smplxpp.capture.recording import TURNTABLE
from smplxpp.core.errors import require_at_least, require_choice, require_positive
from smplxpp.people.fixture_person import CLOTHES, SKIRT_LENGTHS
from smplxpp.people.textures import SKIRT_PATTERNS
from smplxpp.raster.soft_light import LightConfig
from smplxpp.synth.motion import Motion, Performance, Turntable
from smplxpp.synth.simulate import SimulationConfig
from smplxpp.synth.talking import Talking


@dataclass(frozen=True)
class MotionKind:
    """A motion with the defaults of its capture; see `SynthConfig`.

    Attributes:
        make: returns the motion for betas, names of expressions, seconds and seed.
        clothes: one of `CLOTHES`.
        cameras: number of cameras.
        aspect: width of body images by their height.
        truth_step: true meshes are written for every n-th frame.
        normals_step: normal maps are written for every n-th frame.
        texel: side of a cell of the texture atlas, metres; 0: no atlas.
        least_frames: smallest number of frames.
        kind: kind of the capture by one camera (`smplxpp.capture.recording`), of which no frame is held out; None:
            cameras of a rig.
    """

    make: Callable[..., Motion]
    clothes: str = "skirt"
    cameras: int = 12
    aspect: float = 0.8
    truth_step: int = 1
    normals_step: int = 1
    texel: float = 0.0
    least_frames: int = 1
    kind: str | None = None


# Truth of every second frame and normal maps of every fourth keep a capture of 400 frames at a usual size.
MOTIONS = {
    "turning": MotionKind(Performance),
    "talking": MotionKind(
        Talking,
        clothes="trousers",
        cameras=8,
        aspect=0.6,
        truth_step=2,
        normals_step=4,
        texel=0.0007,
        least_frames=2,
    ),
    "turntable": MotionKind(Turntable, clothes="trousers", cameras=1, aspect=0.6, least_frames=4, kind=TURNTABLE),
}


def motion_kind(name: str) -> MotionKind:
    """Return the motion of a name with its defaults.

    Raises:
        InputError: an unknown name.
    """
    require_choice("--motion", name, tuple(MOTIONS))
    return MOTIONS[name]


@dataclass(frozen=True)
class SynthConfig:
    """Size, content and quality of a synthetic capture.

    Attributes:
        cameras: number of cameras; from four on two of them are close-ups of the face.
        frames: number of frames.
        fps: frames per second.
        size: height of body images in pixels.
        seed: seed of the performance, the cameras, the tracker's and the scan's noise.
        layout: "simple" is ours, with everything; "actorshq" holds images, masks and cameras in ActorsHQ's folders.
        supersampling: samples a pixel along each axis.
        quality: quality of JPEG files.
        truth_step: true meshes are written for every n-th frame.
        normals_step: normal maps are written for every n-th frame.
        scan_faces: number of faces of the reference frame's scan; 0 makes no scan.
        motion: name in `MOTIONS`.
        clothes: one of `CLOTHES`.
        outside: root mean square of smooth offsets of her body that no shape of the body model has, metres; so that a
            fit keeps a distance, as on real people.
        skirt_pattern: name in `patterns.SKIRT_PATTERNS`.
        skirt_length: one of `SKIRT_LENGTHS`.
        aspect: width of body images by their height.
        texel: side of a cell of the texture atlas in metres (finer on the head). The atlas is several times as fast as
            procedural colours at every sample, from which it differs by 46 dB. 0: procedural colours.
        simulation: settings of the cloth; its `fps` is replaced by `fps`.
        light: quality of the light.

    Raises:
        InputError: numbers below 1, images too small, or an unknown name.
    """

    cameras: int = 12
    frames: int = 24
    fps: float = 10.0
    size: int = 640
    seed: int = 0
    layout: Literal["simple", "actorshq"] = "simple"
    supersampling: int = 3
    quality: int = 95
    truth_step: int = 1
    normals_step: int = 1
    scan_faces: int = 80_000
    motion: str = "turning"
    clothes: str = "skirt"
    outside: float = 0.0
    skirt_pattern: str = "plaid"
    skirt_length: str = "knee"
    aspect: float = 0.8
    texel: float = 0.0
    simulation: SimulationConfig = field(default_factory=SimulationConfig)
    light: LightConfig = field(default_factory=LightConfig)

    def __post_init__(self) -> None:
        for name in ("cameras", "frames", "supersampling", "truth_step", "normals_step"):
            require_at_least(f"--{name.replace('_', '-')}", getattr(self, name), 1)
        require_at_least("--frames", self.frames, motion_kind(self.motion).least_frames)
        require_at_least("--size", self.size, 16)
        require_at_least("--seed", self.seed, 0)
        require_positive("--fps", self.fps)
        require_positive("aspect of images", self.aspect)
        require_at_least("texel", self.texel, 0.0)
        require_choice("--layout", self.layout, ("simple", "actorshq"))
        require_choice("--clothes", self.clothes, CLOTHES)
        require_choice("--skirt-pattern", self.skirt_pattern, tuple(SKIRT_PATTERNS))
        require_choice("--skirt-length", self.skirt_length, SKIRT_LENGTHS)


def split_frames(frames: int) -> tuple[int, int]:
    """Return the number of training frames, and of the held-out frames after them: the last fifth, rounded down."""
    novel = int(0.2 * frames)
    return frames - novel, novel
