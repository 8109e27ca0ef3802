"""The doll as a capture of six frames with true surfaces, and cheap models on it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from smplxpp.capture import Capture, open_capture
from smplxpp.core.labels import LOWER
from smplxpp.template.template import Template
from tests.training.doll import HELD_OUT, doll, write_capture

FRAMES, NOVEL = 6, (4, 5)
OUT = 0.004
"""Metres by which the true surfaces of odd frames are larger than the doll all around; even frames have none."""


def write_frames(root: Path) -> Path:
    """The doll stands still for six frames; the last two are held out."""
    write_capture(root)
    for path in [*root.rglob("*000000.png"), root / "params" / "000000.npz"]:
        for frame in range(1, FRAMES):
            shutil.copy(path, path.with_name(path.name.replace("000000", f"{frame:06d}")))
    about = {"name": "doll", "novel_views": list(HELD_OUT), "novel_pose_frames": [NOVEL[0], NOVEL[-1]]}
    (root / "capture.json").write_text(json.dumps(about))
    mesh = doll().template.mesh
    (root / "geometry").mkdir()
    np.savez(root / "geometry" / "topology.npz", faces=mesh.faces)
    for frame in range(1, FRAMES, 2):
        np.savez(root / "geometry" / f"frame_{frame:06d}.npz", verts=mesh.vertices + OUT * mesh.vertex_normals)
    return root


@cache
def dressed() -> Template:
    """The doll in a dress: its torso counts as cloth."""
    template = doll().template
    labels = np.where(np.arange(template.vertex_count) < template.vertex_count // 2, LOWER.id, 0)
    return replace(template, vertex_labels=labels)


def opened(root: Path) -> Capture:
    return open_capture(write_frames(root))


@cache
def rig() -> Rig:
    return Rig(doll().template)


def still(own: Rig | None = None) -> Student:
    """Gaussians that follow the joints."""
    own = own or rig()
    return Student(StudentConfig(field=None), own, sample_on_mesh(own.template, SamplingConfig(count=800)), ())


class Grown(Student):
    """A student whose mesh grows by `OUT` along its normals, without a network."""

    def __init__(self, own: Rig) -> None:
        config = StudentConfig(field=FieldConfig(width=8, hidden_layers=1))
        super().__init__(config, own, sample_on_mesh(own.template, SamplingConfig(count=800)), (0, 1, 2, 3))

    def displacements(self, motion):
        return torch.tensor(OUT * self.rig.template.mesh.vertex_normals, dtype=torch.float32)
