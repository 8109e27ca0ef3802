"""The doll that gestures: chest, head and two arms of bare skin, a loose skirt that swings on its own."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from avatar.data.sequence import AvatarSequence, SequenceConfig
from smplxpp.body import load_body
from smplxpp.capture import open_capture
from smplxpp.core import LOWER, BodyParams, Camera, matrix_from_rotvec
from smplxpp.register import BodyState
from smplxpp.template.template import Template
from tests.dolls.doll import Doll, Part, ball, make_template, place_camera

SIZE = (72, 88)
FRAMES, NOVEL_POSES = 6, (5,)
TRAIN, HELD_OUT = ("Ring0", "Ring1", "Ring2", "Ring3"), ("Held0",)
MOVED = ("pelvis", "spine3", "head", "left_shoulder", "right_shoulder")
SIDES = {"left_shoulder": 1.0, "right_shoulder": -1.0}


@cache
def template() -> Template:
    """Hips, chest, head and arms (the body), and a skirt far around the hips."""
    hips = ball((0.14, 0.12, 0.1), 0.3, {"pelvis": 1.0}, subdivisions=2)
    chest = ball((0.16, 0.18, 0.11), 0.52, {"spine3": 1.0}, subdivisions=2)
    head = ball((0.1, 0.13, 0.11), 0.8, {"head": 1.0}, subdivisions=2)
    arms = {name: _arm(name, side) for name, side in SIDES.items()}
    skirt = ball((0.26, 0.16, 0.22), 0.22, {"pelvis": 1.0}, subdivisions=2, label=LOWER.id)
    parts, names = [hips, chest, head, *arms.values()], load_body().joint_names
    vertices = np.concatenate([part.vertices for part in parts])
    places = {"pelvis": (0.0, 0.3, 0.0), "spine3": (0.0, 0.4, 0.0), "head": (0.0, 0.69, 0.0)}
    places |= {name: (0.15 * side, 0.62, 0.0) for name, side in SIDES.items()}
    regressor = np.zeros((len(names), len(vertices)))
    for row, name in enumerate(names):
        place = places.get(name, places["pelvis"])
        nearest = np.argsort(np.linalg.norm(vertices - place, axis=1))[:6]
        regressor[row, nearest] = 1.0 / 6.0
    smile = np.zeros((len(vertices), 3, 2))
    own = slice(len(hips.vertices) + len(chest.vertices), len(hips.vertices) + len(chest.vertices) + len(head.vertices))
    smile[own, 2, 0], smile[own, 1, 1] = 0.02, 0.01
    return make_template(parts, {"skirt": skirt}, bases_changed={"joint_regressor": regressor, "exprdirs": smile})


def _arm(name: str, side: float) -> Part:
    part = ball((0.16, 0.05, 0.05), 0.62, {name: 1.0}, subdivisions=2)
    return Part(part.vertices + [0.3 * side, 0.0, 0.0], part.faces, part.joints)


@cache
def gestures() -> BodyParams:
    """The doll turns a little and waves."""
    t, names = np.arange(FRAMES) / FRAMES, template().body.joint_names
    pose = np.zeros((FRAMES, 55, 3))
    pose[:, 0, 1] = 0.3 * t
    pose[:, names.index("head"), 0] = 0.2 * np.sin(4.0 * t)
    pose[:, names.index("left_shoulder"), 2] = 0.5 * np.sin(3.0 * t)
    pose[:, names.index("right_shoulder"), 1] = 0.4 * t
    return BodyParams.from_full_pose(
        pose,
        betas=np.zeros((FRAMES, 2)),
        expression=np.zeros((FRAMES, 2)),
        transl=0.05 * t[:, None] * [1.0, 0.0, 0.0],
    )


def disturbed(params: BodyParams, *, degrees: float = 1.0, metres: float = 0.005, seed: int = 0) -> BodyParams:
    """Turn the joints that carry something, and move the doll, at random."""
    random, names = np.random.default_rng(seed), template().body.joint_names
    state = BodyState.of_params(template().body, params)
    rotations = state.rotations.copy()
    for name in MOVED:
        turn = np.radians(degrees) * random.normal(size=(len(params), 3))
        rotations[:, names.index(name)] = matrix_from_rotvec(turn) @ rotations[:, names.index(name)]
    shifted = state.transl + metres * random.normal(size=state.transl.shape)
    return BodyState(rotations, shifted, state.betas, state.expression).to_params(template().body)


def cameras() -> dict[str, Camera]:
    """Four around the doll, and one that is held out."""
    angles = zip((*TRAIN, *HELD_OUT), (0, 90, 180, 270, 40), strict=True)
    return {name: place_camera(name, angle, size=SIZE, height=0.7, target=0.5) for name, angle in angles}


@cache
def doll(swing: float = 0.03) -> Doll:
    """Frames whose skirt swings by `swing` metres as no joint does."""
    it = template()
    surfaces = []
    for frame in range(FRAMES):
        moved = swing * np.sin(1.5 * frame) * it.cloth_mask
        surfaces.append(it.pose(gestures().frame(frame))[0] + moved[:, None] * [1.0, 0.0, 0.0])
    rows = tuple(gestures().frame(frame) for frame in range(FRAMES))
    return Doll("gestures", it, cameras(), HELD_OUT, rows, tuple(surfaces), novel_frames=NOVEL_POSES)


def write_gestures(root: Path) -> Path:
    """Write the gestures as a capture."""
    return doll().write_capture(root)


def sequence(capture: Path, params: BodyParams, folder: Path) -> AvatarSequence:
    """The capture with other parameters, written into `folder`."""
    params.save(folder / "start.npz")
    return AvatarSequence(open_capture(capture, params=folder / "start.npz"), template(), SequenceConfig())
