"""The motions by name, and what a capture of each is like unless one asks for something else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pipelines.synth.motion import Motion, Performance
from pipelines.synth.talking import Talking
from smplxpp.core.validation import require_choice


@dataclass(frozen=True)
class MotionKind:
    """A motion with the capture that suits it.

    Attributes:
        make: makes it, of betas, names of expressions, seconds and seed.
        clothes: what the person wears.
        cameras, aspect: how many, and width by height of their images.
        truth_step, normals_step: truth meshes and normal maps of every n-th frame.
        texel: side of a colour's cell on the person, metres, see `SynthConfig`.
        least_frames: shorter is none.
    """

    make: Callable[..., Motion]
    clothes: str = "skirt"
    cameras: int = 12
    aspect: float = 0.8
    truth_step: int = 1
    normals_step: int = 1
    texel: float = 0.0
    least_frames: int = 1


# Truth of every second frame and normal maps of every fourth are what 400 frames leave room for.
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
}


def motion_kind(name: str) -> MotionKind:
    """Return the motion of a name.

    Raises:
        InputError: none of that name; it lists those that there are.
    """
    require_choice("--motion", name, tuple(MOTIONS))
    return MOTIONS[name]
