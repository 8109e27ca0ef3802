"""The doll that dances: a loose dress over two spheres, six frames that move, four cameras and one held out."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from avatar.data.sequence import AvatarSequence, SequenceConfig
from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from smplxpp.body import load_body
from smplxpp.capture import Capture, open_capture
from smplxpp.core import LOWER, BodyParams, Camera
from smplxpp.template.template import Template
from tests.dolls.doll import Doll, ball, make_template, place_camera

WIDTH, HEIGHT = 48, 64
FRAMES, NOVEL_POSES = 6, (4, 5)
TRAIN, HELD_OUT = ("Ring0", "Ring1", "Ring2", "Ring3"), ("Held0",)
EXPRESSIONS = 2


@cache
def template() -> Template:
    """Torso and head (the body), and a dress around the torso that follows two joints."""
    torso = ball((0.2, 0.28, 0.15), 0.35, {"pelvis": 1.0}, subdivisions=2)
    head = ball(0.13, 0.78, {"head": 1.0}, subdivisions=2)
    dress = ball((0.25, 0.31, 0.19), 0.3, {"pelvis": 0.6, "spine1": 0.4}, subdivisions=2, label=LOWER.id)
    size, names = len(torso.vertices), load_body().joint_names
    # About where the body has them: the head turns about its neck.
    regressor = np.zeros((len(names), 2 * size))
    regressor[:, np.argmin(torso.vertices[:, 1])] = 1.0
    regressor[names.index("head")] = 0.0
    regressor[names.index("head"), size + np.argmin(head.vertices[:, 1])] = 1.0
    smile = np.zeros((2 * size, 3, EXPRESSIONS))
    smile[size:, 2, 0], smile[size:, 1, 1] = 0.02, 0.01
    shapes = np.zeros((2 * size, 3, 2))
    shapes[:, 0, 0] = 0.02
    return make_template(
        [torso, head],
        {"dress": dress},
        bases_changed={"joint_regressor": regressor, "shapedirs": shapes, "exprdirs": smile},
        body_index=np.concatenate([np.arange(2 * size), np.arange(size)]),
    )


def there_and_back(frame: int) -> int:
    """The frame of the dance that a longer one shows: it dances back and forth."""
    last = FRAMES - 1
    return last - abs(frame % (2 * last) - last)


@cache
def dance() -> BodyParams:
    """The doll turns, walks a little, nods and smiles."""
    t = np.arange(FRAMES)[:, None] / FRAMES
    pose = np.zeros((FRAMES, 55, 3))
    pose[:, 0, 1:2] = 0.5 * t
    names = template().body.joint_names
    pose[:, names.index("head"), 0:1] = 0.4 * np.sin(5.0 * t)
    pose[:, names.index("spine1"), 2:3] = 0.3 * np.cos(4.0 * t)
    return BodyParams.from_full_pose(
        pose, betas=np.zeros((FRAMES, 2)), expression=np.concatenate([t, 1.0 - t], axis=1), transl=0.1 * t * [1, 0, 0]
    )


def cameras() -> dict[str, Camera]:
    """Four around the doll, and one that is held out."""
    angles = zip((*TRAIN, *HELD_OUT), (0, 90, 180, 270, 40), strict=True)
    return {name: place_camera(name, angle, size=(WIDTH, HEIGHT), height=0.7, target=0.45) for name, angle in angles}


def true_vertices(frame: int) -> np.ndarray:
    """(V, 3) posed, the dress swung to a side as skinning does not have it."""
    it = template()
    swing = 0.03 * np.sin(1.5 * frame) * it.cloth_mask
    return it.pose(dance().frame(frame))[0] + swing[:, None] * [1.0, 0.0, 0.0]


@cache
def doll(count: int = FRAMES) -> Doll:
    """Six frames or more; the last two and one camera are held out."""
    return Doll(
        "dance",
        template(),
        cameras(),
        HELD_OUT,
        params=tuple(dance().frame(there_and_back(frame)) for frame in range(count)),
        surfaces=tuple(true_vertices(there_and_back(frame)) for frame in range(count)),
        novel_frames=(count - 2, count - 1),
    )


def write_dance(root: Path, count: int = FRAMES) -> Path:
    """Write the dance as a capture."""
    return doll(count).write_capture(root)


def write_dance_run(run: Path) -> Path:
    """Write a run that holds nothing but the template."""
    return doll().write_run(run)


def gaussians(count: int = 400) -> BoundGaussians:
    """Sample Gaussians on the template, coloured grey as it is."""
    return sample_on_mesh(template(), SamplingConfig(count=count, sh_degree=1))


def varied(bound: BoundGaussians, seed: int = 0) -> BoundGaussians:
    """Move all attributes of Gaussians from their start."""
    random = torch.Generator().manual_seed(seed)
    moved = {
        name: value + 0.1 * torch.randn(value.shape, generator=random)
        for name, value in bound.tensors.items()
        if name in ("log_scales", "quats", "opacity_logits", "dc", "sh")
    }
    return replace(bound, **moved)


def sequence(capture: Capture | Path, *, device: str = "cpu", **config) -> AvatarSequence:
    """Make what a task is made on."""
    capture = open_capture(capture) if isinstance(capture, Path) else capture
    return AvatarSequence(capture, template(), SequenceConfig(**config), device=device)
