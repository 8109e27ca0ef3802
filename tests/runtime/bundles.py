"""Small students as bundles, and a dressed person whose skirt is simulated."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from avatar.export.bundle import BundleConfig, BundleExtras, write_bundle
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from avatar.runtime import AvatarPlayer
from smplxpp.core.params import BodyParams
from tests.cloth.persons import person, standing
from tests.cloth.test_driver import QUICK, garment, swaying
from tests.dolls.dancing import dance, template
from tests.models.test_model_file import make

KINDS = (
    *("student", "no field", "control points", "still body", "regression"),
    *("shapes", "local", "gated", "pruned", "whole"),
)
EXACT = BundleConfig(exact=True)


@cache
def rig() -> Rig:
    """Of the doll that dances."""
    return Rig(template())


def student(kind: str) -> Student:
    """A doll's student of one of `KINDS`; "whole" has everything that one can have."""
    if kind != "whole":
        return make(kind, rig())
    torch.manual_seed(3)
    known = torch.tensor(dance().body_pose[:4], dtype=torch.float32)
    config = StudentConfig(
        FieldConfig(width=24, hidden_layers=3, code_size=4, local_pose=2),
        BlendShapeConfig(expression_size=2, head_shapes=3, body_shapes=5, width=8, gated=True, jaw=True, parts=3),
        control_points=60,
    )
    it = Student(config, rig(), sample_on_mesh(template(), SamplingConfig(count=400)), (0, 1, 2), known_poses=known)
    with torch.no_grad():
        for name, value in it.named_parameters():
            if not name.startswith("gaussians."):
                # Centimetres, not decimetres: what the hidden layers say is of the order of one.
                size = 0.005 if name.startswith("field.") and ".last." in name else 0.05
                value.add_(size * torch.randn(value.shape))
    return it


def write(path: Path, it: Student, config: BundleConfig | None = None, **extras) -> dict[str, int]:
    """Write a student with a motion."""
    return write_bundle(path, it, BundleExtras(name="doll", motion=dance(), **extras), config)


@cache
def dressed() -> Student:
    """The person of balls in a skirt."""
    torch.manual_seed(1)
    config = StudentConfig(FieldConfig(width=8, hidden_layers=2, code_size=4), None, control_points=40)
    it = Student(config, Rig(person()), sample_on_mesh(person(), SamplingConfig(count=600)), (0, 1))
    with torch.no_grad():
        for value in it.field.parameters():
            value.add_(0.02 * torch.randn(value.shape))
    return it


def write_dressed(folder: Path, config: BundleConfig | None = None) -> None:
    """Write her, with her skirt to be simulated."""
    extras = BundleExtras(name="dressed", garments=[garment()], motion=replace(standing(), fps=20.0))
    write_bundle(folder / "me.avatar", dressed(), extras, config)


def play_dressed(path: Path) -> list[np.ndarray]:
    """Play a bundle as a program does; return where its splats are."""
    player = AvatarPlayer(path, threads=1, cloth=replace(QUICK, ramp=0.0, hold=0.0))
    motion = player.motion
    seen = [] if motion is None else [player.pose(motion.frame(0)).means.copy()]
    frames: list[BodyParams] = [swaying(k / 20.0) for k in range(2)]
    return seen + [player.step(frame, 0.05).means.copy() for frame in frames]
