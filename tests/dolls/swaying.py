"""The doll whose skirt sways as she nods, with a true surface in every frame."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from smplxpp.capture import Capture, open_capture
from smplxpp.core import LOWER, SKIN, BodyParams
from smplxpp.template.template import Template
from tests.dolls.doll import Doll, Part, ball, make_template, place_camera

WIDTH, HEIGHT = 48, 64
TRAIN, HELD_OUT = ("Ring0", "Ring1", "Ring2", "Ring3"), "Held"
ANGLES = (0.0, 0.3, -0.3, 0.15, 0.22)
"""Radians of her nod, frame by frame; the last frame is held out."""
SWAY = 0.25
"""Metres that the hem moves for a nod of one radian, which skinning knows nothing of."""
TORSO = 642
"""Vertices of the torso, which come first; the head's 162 follow."""


@cache
def template() -> Template:
    """Torso and head are the body, an open cone round the legs is the skirt."""
    torso = ball((0.18, 0.34, 0.13), 0.35, {"pelvis": 1.0}, subdivisions=3, label=SKIN.id)
    head = ball(0.13, 0.80, {"head": 1.0}, subdivisions=2, label=SKIN.id)
    random = np.random.default_rng(0)
    smile = 0.002 * random.normal(size=(TORSO + len(head.vertices), 3, 2))
    return make_template([torso, head], {"lower": _skirt(rings=7, sides=24)}, bases_changed={"exprdirs": smile})


def params(frame: int) -> BodyParams:
    """Her nod in a frame."""
    rest = BodyParams.rest(betas=2, expressions=2)
    pose = rest.body_pose.copy()
    pose[0, 3 * (template().body.joint_names.index("head") - 1) + 2] = ANGLES[frame]
    return replace(rest, body_pose=pose, expression=np.array([[ANGLES[frame], 0.5]]))


def truth(frame: int) -> np.ndarray:
    """(V, 3) true surface of a frame: skinned, the skirt swung to the side, most at its hem."""
    it = template()
    vertices = it.pose(params(frame))[0]
    skirt = it.vertex_part == 1
    top, bottom = it.vertices[skirt, 1].max(), it.vertices[skirt, 1].min()
    vertices[skirt, 0] += SWAY * ANGLES[frame] * (top - it.vertices[skirt, 1]) / (top - bottom)
    return vertices


@cache
def doll() -> Doll:
    """Five frames from five cameras; the last frame and the last camera are held out."""
    angles = {name: 90.0 * k for k, name in enumerate(TRAIN)} | {HELD_OUT: 45.0}
    surfaces = tuple(truth(frame) for frame in range(len(ANGLES)))
    view = {"size": (WIDTH, HEIGHT), "height": 0.6, "target": 0.32, "distance": 2.6, "fov": 36.0}
    return Doll(
        "moving doll",
        template(),
        {name: place_camera(name, angle, **view) for name, angle in angles.items()},
        (HELD_OUT,),
        params=tuple(params(frame) for frame in range(len(ANGLES))),
        surfaces=surfaces,
        scanned=dict(enumerate(surfaces)),
        novel_frames=(len(ANGLES) - 1,),
        stripes=25.0,
    )


def write_moving_capture(root: Path) -> Path:
    """Write the frames as a capture."""
    return doll().write_capture(root)


def open_moving(root: Path) -> Capture:
    """Write the frames as a capture, and open it."""
    return open_capture(write_moving_capture(root))


def write_moving_run(run: Path) -> Path:
    """Write a run that holds nothing but the template."""
    return doll().write_run(run)


def _skirt(*, rings: int, sides: int) -> Part:
    """An open cone that follows the root."""
    height = np.linspace(0.25, -0.25, rings)
    radius = np.linspace(0.2, 0.34, rings)
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    vertices = np.stack(
        [np.outer(radius, np.sin(angle)), np.repeat(height[:, None], sides, 1), np.outer(radius, np.cos(angle))], -1
    )
    k, j = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    a, b = k * sides + j, k * sides + (j + 1) % sides
    faces = np.concatenate([np.stack([a, a + sides, b], -1), np.stack([b, a + sides, b + sides], -1)])
    return Part(vertices.reshape(-1, 3), faces.reshape(-1, 3), {"pelvis": 1.0}, LOWER.id)
