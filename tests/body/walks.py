"""A walk whose standing foot stands: joints solved for places of the ankles, on a body of any shape."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.optimize import least_squares

from smplxpp.body import load_body
from smplxpp.body.retarget import Skeleton
from smplxpp.core.params import BodyParams

FPS = 30.0
STEP_FRAMES = 15


def betas(seed: int, size: float = 2.0) -> np.ndarray:
    """A shape far from the mean."""
    return size * np.random.default_rng(seed).normal(size=10)


@cache
def shaped(seed: int | None) -> Skeleton:
    """The open body's joints: of its mean shape, or of one by its seed."""
    return Skeleton.of(load_body(), None if seed is None else betas(seed))


@cache
def walk(seed: int | None, frames: int = 46) -> BodyParams:
    """A walk to the front: while one foot swings, the other's ankle and toes stay where they are."""
    body = shaped(seed)
    rest, leg = body.places, body.leg
    ankles, hips = (body.at(f"left_{part}", f"right_{part}") for part in ("ankle", "hip"))
    speed = 0.45 * leg / STEP_FRAMES
    pose = np.zeros((frames, 55, 3))
    pose[:, body.names.index("left_shoulder"), 2], pose[:, body.names.index("right_shoulder"), 2] = -1.1, 1.1
    transl = np.stack([np.zeros(frames), np.full(frames, -0.06 * leg), speed * np.arange(frames)], axis=1)
    joints = [body.at(f"{side}_hip", f"{side}_knee", f"{side}_ankle") for side in ("left", "right")]
    for k in range(frames):
        for side, (hip, knee, ankle) in enumerate(joints):
            target = rest[ankle] + foot_place(k, side, speed, 0.12 * leg)

            def off(turns: np.ndarray, chain: tuple = (hip, knee, ankle), goal: np.ndarray = target, k: int = k):
                hip, knee, ankle = chain
                one = rotation_x(turns[0]) @ rotation_z(turns[2])
                thigh = one @ (rest[knee] - rest[hip])
                shin = one @ rotation_x(turns[1]) @ (rest[ankle] - rest[knee])
                return rest[hip] + transl[k] + thigh + shin - goal

            found = least_squares(off, np.array([-0.3, 0.6, 0.0]), xtol=1e-14, ftol=1e-14, gtol=1e-14).x
            whole = rotation_x(found[0]) @ rotation_z(found[2])
            pose[k, hip] = rotvec(whole)
            pose[k, knee, 0] = found[1]
            pose[k, ankle] = rotvec((whole @ rotation_x(found[1])).T)  # the sole stays level
    assert ankles and hips
    params = BodyParams.from_full_pose(pose, betas=np.zeros(0), expression=np.zeros(0), transl=transl)
    return replace(params, fps=FPS)


def foot_place(k: int, side: int, speed: float, lift: float) -> np.ndarray:
    """Where an ankle is in a frame, from where it is at rest: it stands for a step, then swings for one."""
    at = (k + side * STEP_FRAMES) / (2 * STEP_FRAMES)
    cycle, phase = np.floor(at), at % 1.0
    begin = (2 * cycle - side) * STEP_FRAMES * speed
    swing = max(0.0, 2.0 * phase - 1.0)
    forward = begin + 2 * STEP_FRAMES * speed * (3 * swing**2 - 2 * swing**3)
    return np.array([0.0, lift * np.sin(np.pi * swing) ** 2, forward + 0.5 * STEP_FRAMES * speed])


def stands(frames: int, side: int) -> np.ndarray:
    """Which steps from frame to frame a foot stands through."""
    phase = ((np.arange(frames) + side * STEP_FRAMES) / (2 * STEP_FRAMES)) % 1.0
    return (phase[:-1] <= 0.5) & (phase[1:] <= 0.5)


def slide(body: Skeleton, params: BodyParams) -> float:
    """Millimetres that standing ankles move on the floor in a step, the mean."""
    places = body.pose(params)[:, body.at("left_ankle", "right_ankle")]
    total, steps = 0.0, 0
    for side in (0, 1):
        standing = stands(len(params), side)
        moved = np.linalg.norm(np.diff(places[:, side], axis=0)[:, [0, 2]], axis=1)
        total += 1e3 * moved[standing].sum()
        steps += standing.sum() / STEP_FRAMES
    return total / steps


def rotation_x(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotvec(matrix: np.ndarray) -> np.ndarray:
    from smplxpp.core.rotations import rotvec_from_matrix

    return rotvec_from_matrix(matrix)
