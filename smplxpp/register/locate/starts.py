"""Rank the starts of a search: library poses in all directions, scaled to the height of the surface."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.core.surface_points import SurfacePoints, truncated_distance
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.locate.proxy import BodyProxy

Poses = Iterable[tuple[str, Float64[np.ndarray, "J 3"]]]
"""Names and axis-angle vectors of poses, radians."""


@dataclass(frozen=True, eq=False)
class StartPose:
    """A pose that was moved onto a surface.

    Attributes:
        name: of the pose.
        yaw: rotation about +Y, radians.
        state: the body, one frame.
        cost: mean distance with the cost of the stature, metres.
    """

    name: str
    yaw: float
    state: BodyState
    cost: float


def rank_starts(
    kinematics: Kinematics, proxy: BodyProxy, surface: SurfacePoints, poses: Poses, *, directions: int, keep: int
) -> list[StartPose]:
    """Rank all poses in all directions by their distance to a surface, and return the best.

    Args:
        kinematics: of the body.
        proxy: points of the body.
        surface: points of the scan.
        poses: names and axis-angle vectors of the poses.
        directions: number of directions, evenly about the vertical axis.
        keep: number of starts to return, spread over the directions.
    """
    low, high = _ends(surface.points[:, 1])
    rise = _stature_direction(kinematics)
    found: list[StartPose] = []
    for name, vectors in poses:
        rotations = matrix_from_rotvec(vectors)
        # Scale the posed points to the height of the surface, and put them on its lowest point.
        state = _standing(kinematics, rotations)
        points, normals = proxy.posed(kinematics, kinematics.posture(state, 0))
        bottom, top = points[:, 1].min(), points[:, 1].max()
        scale = (high - low) / (top - bottom)
        middle = points.mean(axis=0)
        points = (points - middle) * scale
        points[:, 1] += low - points[:, 1].min()
        for k in range(directions):
            yaw = 2.0 * np.pi * k / directions
            turn = matrix_from_rotvec(np.array([0.0, yaw, 0.0]))
            # Rotate about the vertical axis, over the middle of the surface.
            there, facing = points @ turn.T, normals @ turn.T
            there[:, [0, 2]] += surface.points[:, [0, 2]].mean(axis=0)
            # A stature of 1.5 times the mean, or of 1/1.5, costs as much as 5 cm of distance.
            cost = truncated_distance(there, facing, surface) + 0.05 * abs(np.log2(scale)) / np.log2(1.5)
            found.append(StartPose(name, yaw, _placed(kinematics, rotations, yaw, scale, rise, there), cost))
    return _spread(found, directions, keep)


def _spread(found: list[StartPose], directions: int, keep: int) -> list[StartPose]:
    """Return the best of each direction and then the best of all, so that every direction is represented."""
    found = sorted(found, key=lambda start: start.cost)
    by_yaw: dict[float, list[StartPose]] = {}
    for start in found:
        by_yaw.setdefault(start.yaw, []).append(start)
    share = max(1, keep // (2 * directions))
    chosen = [start for group in by_yaw.values() for start in group[:share]]
    best = [start for start in found if start not in chosen][: max(0, keep - len(chosen))]
    return sorted(chosen + best, key=lambda start: start.cost)


def _standing(kinematics: Kinematics, rotations: np.ndarray) -> BodyState:
    body = kinematics.body
    return BodyState(
        rotations[None].copy(), np.zeros((1, 3)), np.zeros(body.num_betas), np.zeros((1, body.num_expressions))
    )


def _placed(
    kinematics: Kinematics, rotations: np.ndarray, yaw: float, scale: float, rise: np.ndarray, there: np.ndarray
) -> BodyState:
    """Return the placed pose as a state: the size in betas, within +-3, and the translation at the points' mean."""
    state = _standing(kinematics, rotations)
    state.rotations[0, 0] = matrix_from_rotvec(np.array([0.0, yaw, 0.0])) @ rotations[0]
    betas = np.clip((scale - 1.0) * rise, -3.0, 3.0)
    return BodyState(state.rotations, there.mean(axis=0)[None], betas, state.expression)


def centred(kinematics: Kinematics, proxy: BodyProxy, start: StartPose) -> BodyState:
    """Return the state of a start, moved so that the mean of its points is at the start's translation."""
    points, _ = proxy.posed(kinematics, kinematics.posture(start.state, 0))
    move = start.state.transl[0] - (points.mean(axis=0) - start.state.transl[0])
    return BodyState(start.state.rotations, move[None], start.state.betas, start.state.expression)


def _stature_direction(kinematics: Kinematics) -> Float64[np.ndarray, " B"]:
    """Return the betas of least norm that double the height of the mean body."""
    body = kinematics.body
    top, bottom = np.argmax(body.v_template[:, 1]), np.argmin(body.v_template[:, 1])
    slope = body.shapedirs[top, 1] - body.shapedirs[bottom, 1]
    height = body.v_template[top, 1] - body.v_template[bottom, 1]
    return height * slope / (slope @ slope)


def _ends(heights: np.ndarray) -> tuple[float, float]:
    return float(heights.min()), float(heights.max())
