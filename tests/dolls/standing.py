"""The doll that stands still: two spheres before a ring of cameras, one frame or six, and cheap models on it."""

from __future__ import annotations

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
from smplxpp.core import LOWER, BodyParams
from smplxpp.template.template import Template
from tests.dolls.doll import Doll, ball, make_template, place_camera

WIDTH, HEIGHT = 64, 80
TRAIN, HELD_OUT = ("Ring0", "Ring1", "Ring2", "Ring3", "Ring4", "Ring5", "Face"), ("Held0", "Held1")
STRIPES = 40.0
FRAMES, NOVEL = 6, (4, 5)
OUT = 0.004
"""Metres by which the true surfaces of odd frames are larger than the doll all around; even frames have none."""


@cache
def doll() -> Doll:
    """One frame. The template's own colours are one grey: all colour comes from the images."""
    template = make_template(
        [
            ball((0.22, 0.3, 0.16), 0.35, {"pelvis": 1.0}, subdivisions=3),
            ball(0.13, 0.78, {"head": 1.0}, subdivisions=3),
        ]
    )
    size = (WIDTH, HEIGHT)
    cameras = {name: place_camera(name, 60.0 * k, size=size, height=0.9, target=0.48) for k, name in enumerate(TRAIN)}
    cameras["Face"] = place_camera("Face", 15.0, size=size, height=0.8, target=0.78, fov=14.0)
    for k, name in enumerate(HELD_OUT):
        cameras[name] = place_camera(name, 30.0 + 180.0 * k, size=size, height=0.7, target=0.48)
    return Doll(
        "doll",
        template,
        cameras,
        HELD_OUT,
        params=(BodyParams.rest(betas=2, expressions=0),),
        surfaces=(template.vertices,),
        stripes=STRIPES,
        supersampling=4,
    )


@cache
def six_frames() -> Doll:
    """It stands still for six frames, with true surfaces for the odd ones; the last two are held out."""
    it = doll()
    mesh = it.template.mesh
    return replace(
        it,
        params=FRAMES * it.params,
        surfaces=FRAMES * it.surfaces,
        scanned={frame: mesh.vertices + OUT * mesh.vertex_normals for frame in range(1, FRAMES, 2)},
        novel_frames=NOVEL,
    )


@cache
def dressed() -> Template:
    """The doll in a dress: its torso counts as cloth."""
    template = doll().template
    labels = np.where(np.arange(template.vertex_count) < template.vertex_count // 2, LOWER.id, 0)
    return replace(template, vertex_labels=labels)


def write_capture(root: Path) -> Path:
    """Write the one frame as a capture."""
    return doll().write_capture(root)


def write_run(run: Path) -> Path:
    """Write a run that holds nothing but the template."""
    return doll().write_run(run)


def write_frames(root: Path) -> Path:
    """Write the six frames as a capture."""
    return six_frames().write_capture(root)


def opened(root: Path) -> Capture:
    """Write the six frames as a capture, and open it."""
    return open_capture(write_frames(root))


@cache
def rig() -> Rig:
    """The doll's, for torch."""
    return Rig(doll().template)


def still(own: Rig | None = None) -> Student:
    """Make Gaussians that follow the joints."""
    own = own or rig()
    return Student(StudentConfig(field=None), own, sample_on_mesh(own.template, SamplingConfig(count=800)), ())


class Grown(Student):
    """A student whose mesh grows by `OUT` along its normals, without a network."""

    def __init__(self, own: Rig) -> None:
        config = StudentConfig(field=FieldConfig(width=8, hidden_layers=1))
        super().__init__(config, own, sample_on_mesh(own.template, SamplingConfig(count=800)), (0, 1, 2, 3))

    def displacements(self, pose):
        return torch.tensor(OUT * self.rig.template.mesh.vertex_normals, dtype=torch.float32)
