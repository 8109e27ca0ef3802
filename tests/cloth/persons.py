"""A person of balls in a skirt: what garments are cut from."""

from __future__ import annotations

from functools import cache

import numpy as np

from smplxpp.body import load_body
from smplxpp.core import LOWER, UPPER, BodyParams
from smplxpp.template.template import Template
from tests.dolls.doll import Part, ball, make_template

PART = LOWER.name
OVER = UPPER.name
"""A second skirt over the first one."""
AROUND, DOWN = 48, 20
WAIST, HEM = 0.95, 0.45
"""Heights of the skirt's openings, metres."""


@cache
def person(
    *, bridge: int = 0, tight: bool = True, outwards: bool = True, torn: bool = False, layers: int = 1
) -> Template:
    """Hips, two legs, a head, and a skirt from the waist to the knees.

    Args:
        bridge: rings of faces that close the hem inwards, as a scan does, a centimetre each.
        tight: the waistband lies on the hips; else it hangs 9 cm from them.
        outwards: the skirt's faces look out.
        torn: a slit from hem to waist, and a piece that hangs together with nothing.
        layers: 2: another skirt, 2 cm outside the first.
    """
    hips = ball((0.16, 0.2, 0.12), 0.92, {"pelvis": 1.0}, subdivisions=4)
    legs = [_leg(name, x) for name, x in (("left_hip", 0.08), ("right_hip", -0.08))]
    skirt = _skirt(bridge=bridge, tight=tight, outwards=outwards, torn=torn)
    skirts = {PART: skirt}
    if layers > 1:
        away = np.where(np.arange(len(skirt.vertices)) < AROUND, 0.0, 0.02)  # they share the waistband
        outer = skirt.vertices * [1, 0, 1]
        outer *= 1 + away[:, None] / np.linalg.norm(outer, axis=1, keepdims=True)
        skirts[OVER] = Part(outer + skirt.vertices * [0, 1, 0] + [0, 0.002, 0], skirt.faces, skirt.joints, UPPER.id)
    names = load_body().joint_names
    head = ball((0.09, 0.12, 0.1), 1.3, {"head": 1.0}, subdivisions=3)
    parts = [hips, *legs, head]
    vertices = np.concatenate([part.vertices for part in parts])
    places = {"left_hip": (0.08, 0.85, 0.0), "right_hip": (-0.08, 0.85, 0.0)}
    regressor = np.zeros((len(names), len(vertices)))
    for row, name in enumerate(names):
        nearest = np.argsort(np.linalg.norm(vertices - places.get(name, (0.0, 0.92, 0.0)), axis=1))[:6]
        regressor[row, nearest] = 1.0 / 6.0
    return make_template(parts, skirts, bases_changed={"joint_regressor": regressor})


def _leg(name: str, x: float) -> Part:
    part = ball((0.07, 0.42, 0.07), 0.45, {name: 1.0}, subdivisions=4)
    return Part(part.vertices + [x, 0.0, 0.0], part.faces, part.joints)


def _skirt(*, bridge: int, tight: bool, outwards: bool, torn: bool) -> Part:
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    circle = np.stack([np.sin(angle), np.zeros(AROUND), np.cos(angle)], axis=1)
    t = np.linspace(0.0, 1.0, DOWN)
    # The hips' half axes at the waist, and what the skirt adds to them on its way down.
    wide = (0.006 if tight else 0.09) + 0.05 * t
    rings = [
        circle * [0.158 + w, 0, 0.119 + w] + [0, (1 - s) * WAIST + s * HEM, 0] for s, w in zip(t, wide, strict=True)
    ]
    rings += [rings[-1] * [s, 1, s] for s in 1.0 - 0.05 * np.arange(1, bridge + 1)]
    rows = len(rings)
    a = (np.arange(rows - 1)[:, None] * AROUND + np.arange(AROUND)).ravel()
    b = (np.arange(rows - 1)[:, None] * AROUND + (np.arange(AROUND) + 1) % AROUND).ravel()
    faces = np.concatenate([np.stack([a, a + AROUND, b], 1), np.stack([b, a + AROUND, b + AROUND], 1)])
    vertices = np.concatenate(rings)
    if torn:
        column = np.concatenate([np.tile(np.arange(AROUND), rows - 1)] * 2)
        faces = faces[column != 5]
        scrap = np.array([[0.5, 0.5, 0.0], [0.5, 0.4, 0.0], [0.6, 0.4, 0.0]])
        faces = np.concatenate([faces, len(vertices) + np.array([[0, 1, 2]])])
        vertices = np.concatenate([vertices, scrap])
    return Part(vertices, faces if outwards else faces[:, ::-1], {"pelvis": 1.0}, LOWER.id)


def standing(
    *, at: tuple[float, float, float] = (0.0, 0.0, 0.0), turned: float = 0.0, lifted: float = 0.0, swung: float = 0.0
) -> BodyParams:
    """One frame.

    Args:
        at: metres. turned: about the vertical, lifted: the left leg to the front, swung: the hips about the axis to the
            front, radians.
    """
    pose = np.zeros((1, 55, 3))
    pose[:, 0, 1], pose[:, 0, 2] = turned, swung
    pose[:, load_body().joint_names.index("left_hip"), 0] = -lifted
    return BodyParams.from_full_pose(
        pose, betas=np.zeros((1, 2)), expression=np.zeros((1, 0)), transl=np.array([at], dtype=float)
    )
