"""Make the things that procedural people hold or wear: closed meshes at hand, head or trunk, in the person's pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from smplxpp.body import BodyModel, PosedBody
from smplxpp.core import InputError, TriangleMesh


@dataclass(frozen=True)
class Thing:
    """A thing that a person holds or wears.

    Attributes:
        kind: name among `THINGS` or `WORN`.
        side: "left" or "right" hand; of a bag on a strap, the hip.
        color: sRGB.
    """

    kind: str
    side: str = "left"
    color: tuple[int, int, int] = (40, 60, 120)

    def __post_init__(self) -> None:
        if self.kind not in (*THINGS, *WORN):
            raise InputError("thing", expected=f"one of {', '.join((*THINGS, *WORN))}", received=self.kind)
        if self.side not in ("left", "right"):
            raise InputError("hand", expected="left or right", received=self.side)


def thing_mesh(thing: Thing, body: BodyModel, posed: PosedBody) -> TriangleMesh:
    """Return the closed mesh of a thing on the first posed body, metres.

    What a hand grips is placed in the frame of the wrist: x along the fingers, y out of the back of the hand, z towards
    the thumb. What hangs from it stands upright in the world, whatever the hand does.
    """
    if thing.kind in WORN:
        return _joined(WORN[thing.kind](body, posed, 1.0 if thing.side == "left" else -1.0))
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
    return _joined([piece @ turn.T + knuckles for piece in points()])


def _joined(convex: list[np.ndarray]) -> TriangleMesh:
    """Return the convex hulls of some sets of points as one mesh."""
    pieces = [_hull(points) for points in convex]
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


def _glasses(body: BodyModel, posed: PosedBody, lens: np.ndarray, rim: float) -> list[np.ndarray]:
    """Two lenses before the eyes, a bridge, and two temples, in the frame of the head.

    Args:
        body: the model.
        posed: its first body wears them.
        lens: points of a lens about the middle of the eye.
        rim: radius of bridge and temples, metres.
    """
    eyes, turn = _head(body, posed)
    left, right = eyes
    middle, half = 0.5 * (left + right), 0.5 * float(np.linalg.norm(left - right))
    lenses = [lens + [sign * half, 0.0, 0.033] for sign in (1.0, -1.0)]
    temples = [_tube(rim, (sign * 0.072, 0.004, 0.034), (sign * 0.078, 0.008, -0.075)) for sign in (1.0, -1.0)]
    rims = [_tube(rim, (sign * half, 0.0, 0.033), (sign * 0.072, 0.004, 0.033)) for sign in (1.0, -1.0)]
    bridge = _tube(rim, (-0.012, 0.004, 0.035), (0.012, 0.004, 0.035))
    return [piece @ turn.T + middle for piece in (*lenses, *rims, *temples, bridge)]


def _hat(body: BodyModel, posed: PosedBody, crown: float, brim: float, forward: float) -> list[np.ndarray]:
    """A crown over the top of the head and a brim about it, in the frame of the head.

    Args:
        body: the model.
        posed: its first body wears it.
        crown: height of the crown, metres; its edge is round where it is below 10 cm.
        brim: radius of the brim, metres.
        forward: distance in metres of the brim before the middle of the head, as the peak of a cap.
    """
    _, turn = _head(body, posed)
    head = posed.vertices[0][body.weights[:, body.joint_names.index("head")] > 0.9] @ turn
    x, z = 0.5 * (head.min(axis=0) + head.max(axis=0))[[0, 2]]
    band = float(head[:, 1].max()) - 0.055  # metres, where the hat sits on the forehead
    if crown < 0.1:
        dome = _ball((0.108, crown, 0.115), (x, band, z))
        top = dome[dome[:, 1] > band]
    else:
        top = _tube(0.108, (x, band, z), (x, band + crown, z))
    edge = _tube(brim, (x, band, z + forward), (x, band + 0.012, z + forward))
    return [piece @ turn.T for piece in (top, edge)]


def _headphones(body: BodyModel, posed: PosedBody, side: float) -> list[np.ndarray]:
    """A cup over either ear and a band over the top of the head between them, in the frame of the head."""
    eyes, turn = _head(body, posed)
    head = posed.vertices[0][body.weights[:, body.joint_names.index("head")] > 0.9] @ turn
    eye = 0.5 * (eyes[0] + eyes[1]) @ turn
    x, z = eye[0], 0.5 * float(head[:, 2].min() + head[:, 2].max())
    y = float(eye[1]) - 0.02  # metres, the middle of the ears
    top, half = float(head[:, 1].max()) - y + 0.012, float(np.abs(head[:, 0] - x).max())
    cups = [_tube(0.037, (x + sign * (half - 0.02), y, z), (x + sign * (half + 0.02), y, z)) for sign in (1.0, -1.0)]
    angle = np.linspace(0.0, np.pi, 13)
    arc = np.stack([x + (half + 0.012) * np.cos(angle), y + top * np.sin(angle), np.full(13, z)], axis=1)
    band = [_tube(0.009, tuple(start), tuple(end)) for start, end in pairwise(arc)]
    return [piece @ turn.T for piece in (*cups, *band)]


def _trunk(body: BodyModel, posed: PosedBody, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the place of a joint of the trunk, the axes right, up and front there, and the trunk's skin in them."""
    joint = body.joint_names.index(name)
    turn = posed.posed_from_rest[0][joint][:3, :3]
    place = posed.joints[0][joint]
    kept = [k for k, one in enumerate(body.joint_names) if one.startswith(("pelvis", "spine")) or "collar" in one]
    skin = posed.vertices[0][body.weights[:, kept].sum(axis=1) > 0.6]
    return place, turn, (skin - place) @ turn


def _belt_bag(body: BodyModel, posed: PosedBody, side: float) -> list[np.ndarray]:
    """A bag before one hip, 25 mm off the skin for the clothes below."""
    place, turn, skin = _trunk(body, posed, "pelvis")
    x = 0.09 * side
    beside = skin[(np.abs(skin[:, 0] - x) < 0.09) & (np.abs(skin[:, 1] - 0.02) < 0.08)]
    return [_ball((0.11, 0.08, 0.055), (x, 0.02, float(beside[:, 2].max()) + 0.045)) @ turn.T + place]


def _backpack(body: BodyModel, posed: PosedBody, side: float) -> list[np.ndarray]:
    """A bag on the back with a strap over either shoulder."""
    place, turn, skin = _trunk(body, posed, "spine3")
    back, front = float(skin[:, 2].min()) - 0.015, float(skin[:, 2].max()) + 0.015
    top = float(skin[np.abs(skin[:, 0]) > 0.08, 1].max()) + 0.02
    pieces = [_box((0.30, 0.42, 0.15), (0.0, -0.08, back - 0.075))]
    for x in (-0.1, 0.1):
        at = [(x, -0.02, back), (x, top, -0.03), (x, -0.02, front), (x, -0.14, 0.5 * (front + back))]
        pieces += [_tube(0.015, start, end) for start, end in pairwise(at)]
    return [piece @ turn.T + place for piece in pieces]


def _shoulder_bag(body: BodyModel, posed: PosedBody, side: float) -> list[np.ndarray]:
    """A bag at one hip on a strap over the other shoulder, 25 mm off the skin for the clothes below."""
    at = {name: k for k, name in enumerate(body.joint_names)}
    own, other = ("left", "right") if side > 0 else ("right", "left")
    joints, vertices = posed.joints[0], posed.vertices[0]
    # The strap lies in the plane through hip and shoulder that looks along the trunk's front.
    front = posed.posed_from_rest[0][at["pelvis"]][:3, 2]
    hip = joints[at[f"{own}_hip"]] + [0.0, 0.02, 0.0]
    shoulder = 0.5 * (joints[at[f"{other}_collar"]] + joints[at[f"{other}_shoulder"]])
    up = (shoulder - hip) / np.linalg.norm(shoulder - hip)
    depth = front - (front @ up) * up
    depth /= np.linalg.norm(depth)
    normal = np.cross(up, depth)
    trunk = [k for name, k in at.items() if name.startswith(("pelvis", "spine")) or "collar" in name or "hip" in name]
    skin = vertices[body.weights[:, trunk].sum(axis=1) > 0.6] - hip
    near = skin[np.abs(skin @ normal) < 0.02]
    flat = np.stack([near @ up, near @ depth], axis=1)
    ring = flat[ConvexHull(flat).vertices]
    out = ring - ring.mean(axis=0)
    ring = ring.mean(axis=0) + out * (1.0 + 0.025 / np.linalg.norm(out, axis=1, keepdims=True))
    places = hip + ring[:, :1] * up + ring[:, 1:] * depth
    away = hip + ring.mean(axis=0)[0] * up + ring.mean(axis=0)[1] * depth
    pieces = []
    for start, end in zip(places, np.roll(places, -1, axis=0), strict=True):
        thick = 0.5 * (start + end) - away
        thick *= 0.006 / np.linalg.norm(thick)
        pieces.append(
            np.stack([p + w * normal + t * thick for p in (start, end) for w in (-0.02, 0.02) for t in (0.0, 1.0)])
        )
    # The bag hangs upright beside the hip and touches the widest skin there.
    right = np.cross([0.0, 1.0, 0.0], front)
    right *= side / np.linalg.norm(right)
    level = skin[np.abs(skin[:, 1]) < 0.08]
    beside = float((level @ right).max()) + 0.045
    frame = np.stack([front / np.linalg.norm(front), [0.0, 1.0, 0.0], right], axis=1)
    return [*pieces, _box((0.28, 0.22, 0.09), (0.0, -0.06, beside)) @ frame.T + hip]


def _head(body: BodyModel, posed: PosedBody) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return the places of both eyes and the rotation of the head."""
    left, right = (body.joint_names.index(f"{side}_eye_smplhf") for side in ("left", "right"))
    return (posed.joints[0][left], posed.joints[0][right]), posed.posed_from_rest[0][body.joint_names.index("head")][
        :3, :3
    ]


_ROUND, _SQUARE = _tube(0.026, (0.0, 0.0, -0.003), (0.0, 0.0, 0.003)), _box((0.056, 0.042, 0.006), (0.0, 0.0, 0.0))
WORN: dict[str, Callable[[BodyModel, PosedBody, float], list[np.ndarray]]] = {
    "glasses": lambda body, posed, side: _glasses(body, posed, _ROUND, 0.004),
    "sunglasses": lambda body, posed, side: _glasses(body, posed, _SQUARE, 0.006),
    "goggles": lambda body, posed, side: _glasses(body, posed, _box((0.075, 0.06, 0.03), (0.0, 0.0, 0.01)), 0.008),
    "brimmed hat": lambda body, posed, side: _hat(body, posed, 0.11, 0.19, 0.0),
    "top hat": lambda body, posed, side: _hat(body, posed, 0.18, 0.15, 0.0),
    "cap": lambda body, posed, side: _hat(body, posed, 0.09, 0.09, 0.09),
    "headphones": _headphones,
    "shoulder bag": _shoulder_bag,
    "belt bag": _belt_bag,
    "backpack": _backpack,
}
"""For each kind, the points of its convex pieces on a posed body; 1 or -1 is the left or the right side."""
