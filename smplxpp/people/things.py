"""Make the things that procedural people hold: closed meshes at a hand, in the pose of the person."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from smplxpp.body import BodyModel, PosedBody
from smplxpp.core import InputError, TriangleMesh


@dataclass(frozen=True)
class Thing:
    """A thing that a person holds.

    Attributes:
        kind: name among `THINGS`.
        side: "left" or "right" hand.
        color: sRGB.
    """

    kind: str
    side: str = "left"
    color: tuple[int, int, int] = (40, 60, 120)

    def __post_init__(self) -> None:
        if self.kind not in THINGS:
            raise InputError("thing in a hand", expected=f"one of {', '.join(THINGS)}", received=self.kind)
        if self.side not in ("left", "right"):
            raise InputError("hand", expected="left or right", received=self.side)


def thing_mesh(thing: Thing, body: BodyModel, posed: PosedBody) -> TriangleMesh:
    """Return the closed mesh of a thing at the hand of the first posed body, metres.

    What a hand grips is placed in the frame of the wrist: x along the fingers, y out of the back of the hand, z towards
    the thumb. What hangs from it stands upright in the world, whatever the hand does.
    """
    at = {name: k for k, name in enumerate(body.joint_names)}
    joint, sign = at[f"{thing.side}_wrist"], 1.0 if thing.side == "left" else -1.0
    knuckles = posed.joints[0][at[f"{thing.side}_middle1"]]
    hangs, points = THINGS[thing.kind]
    # Mirror the frame for the right hand, whose fingers point to -x in the T-pose.
    turn = posed.posed_from_rest[0][joint][:3, :3] @ np.diag([sign, 1.0, 1.0])
    if hangs:
        # Upright: y up, x along the horizontal direction in which the palm's plane runs from back to front.
        forward = turn[:, 2] * [1.0, 0.0, 1.0]
        forward /= np.linalg.norm(forward)
        turn = np.stack([forward, [0.0, 1.0, 0.0], np.cross(forward, [0.0, 1.0, 0.0])], axis=1)
    pieces = [_hull(piece @ turn.T + knuckles) for piece in points()]
    count = np.cumsum([0] + [piece.vertex_count for piece in pieces])
    return TriangleMesh(
        np.concatenate([piece.vertices for piece in pieces]),
        np.concatenate([piece.faces + start for piece, start in zip(pieces, count, strict=False)]),
    )


def _hull(points: Float[np.ndarray, "N 3"]) -> TriangleMesh:
    """Return the convex hull of points, wound outwards."""
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = np.einsum("ij,ij->i", normal, hull.equations[:, :3]) < 0
    faces = np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, index = np.unique(faces, return_inverse=True)
    return TriangleMesh(points[used], index.reshape(-1, 3))


def _box(size: tuple[float, float, float], center: tuple[float, float, float]) -> np.ndarray:
    corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return corners * size + center


def _tube(radius: float, start: tuple[float, float, float], end: tuple[float, float, float]) -> np.ndarray:
    """Points of a cylinder from one point to another."""
    axis = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
    side = np.cross(axis, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    angle = np.linspace(0.0, 2.0 * np.pi, 17)[:-1, None]
    ring = radius * (np.cos(angle) * side + np.sin(angle) * np.cross(axis, side))
    return np.concatenate([ring + start, ring + end])


def _ball(radius: tuple[float, float, float], center: tuple[float, float, float]) -> np.ndarray:
    k = np.arange(400) + 0.5
    polar, turn = np.arccos(1.0 - 2.0 * k / 400), np.pi * (1.0 + 5.0**0.5) * k
    points = np.stack([np.sin(polar) * np.cos(turn), np.cos(polar), np.sin(polar) * np.sin(turn)], axis=1)
    return points * radius + center


THINGS: dict[str, tuple[bool, Callable[[], list[np.ndarray]]]] = {
    "binder": (False, lambda: [_box((0.30, 0.045, 0.24), (0.03, -0.045, 0.03))]),
    "folder": (False, lambda: [_box((0.34, 0.03, 0.26), (-0.12, -0.055, 0.02))]),
    "book": (False, lambda: [_box((0.16, 0.025, 0.22), (0.03, -0.035, 0.06))]),
    "ball": (False, lambda: [_ball((0.11, 0.11, 0.11), (0.02, -0.12, 0.0))]),
    "bottle": (False, lambda: [_tube(0.035, (0.01, -0.045, -0.09), (0.01, -0.045, 0.15))]),
    "stick": (False, lambda: [_tube(0.016, (0.015, -0.03, -0.5), (0.015, -0.03, 0.35))]),
    "tray": (False, lambda: [_tube(0.17, (0.05, -0.03, 0.0), (0.05, -0.05, 0.0))]),
    "racket": (
        False,
        lambda: [
            _tube(0.017, (0.015, -0.03, -0.08), (0.015, -0.03, 0.32)),
            _ball((0.12, 0.015, 0.15), (0.015, -0.03, 0.44)),
        ],
    ),
    "case": (
        True,
        lambda: [_box((0.40, 0.30, 0.10), (0.0, -0.24, 0.0)), _box((0.14, 0.12, 0.03), (0.0, -0.08, 0.0))],
    ),
    "bag": (
        True,
        lambda: [_ball((0.17, 0.16, 0.09), (0.0, -0.26, 0.0)), _tube(0.02, (0.0, -0.14, 0.0), (0.0, -0.03, 0.0))],
    ),
    "parcel": (False, lambda: [_box((0.22, 0.20, 0.22), (0.02, -0.13, 0.0))]),
}
"""For each kind: whether it hangs upright from the hand, and the points of its convex pieces, metres from the
knuckles."""
