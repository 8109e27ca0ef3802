"""ARKit's expressions on a body whose own are numbered (SMPL-X, FLAME): solved from what its directions do to its face.

The embedded body has both: ARKit's names and a surface. Its face is laid over the other one by eyes and mouth, its
displacements are carried to the nearest points (upper lip to upper, lower to lower), and the coefficients that repeat
them are found by least squares, `min_c |W (D c - t)|^2 + w |G (D c - t)|^2 + r |c|^2` within bounds; G takes the gap
between the lips, so that what closes there closes here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.optimize import lsq_linear
from scipy.spatial import cKDTree

from avatar.speech.arkit import ARKIT
from smplxpp.body import load_body
from smplxpp.body.model import BodyModel
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams

_MOST = 3.0  # of a numbered expression, either way: its body was made from little beyond (standard deviations)
_EYES = ("left_eye_smplhf", "right_eye_smplhf")
_LIPS = 0.007  # metres between vertices of both lips, where the mouth is closed, on a face of an adult
_DEEP = 0.02  # metres behind the foremost of them: lips, not what is behind them
_BESIDE = 0.55  # of the distance between the eyes: half the width in which lips are looked for
_NEAR = {"mouth": 1.0, "eyes": 0.45}  # of that distance: the parts of the face that are fitted
_BEHIND = 0.6  # of it, behind the eyes: the face ends there
_ELSEWHERE, _GAP, _RIDGE = 0.2, 4.0, 0.02  # weights, of a vertex's 1


@dataclass(frozen=True, eq=False)
class FaceSurface:
    """A face at rest, and what its body's expressions do to it.

    Attributes:
        vertices: metres. directions: metres at an expression of 1. lower: whether a vertex follows the jaw.
        eyes: where the left and the right one turn.
    """

    vertices: Float64[np.ndarray, "N 3"]
    directions: Float64[np.ndarray, "N 3 E"]
    lower: Bool[np.ndarray, " N"]
    eyes: Float64[np.ndarray, "2 3"]

    @staticmethod
    def of(body: BodyModel) -> FaceSurface:
        """Return the front of a body's head.

        Raises:
            InputError: no eyes, no jaw or no expressions.
        """
        names = list(body.joint_names)
        missing = [name for name in (*_EYES, "head", "jaw") if name not in names]
        if missing or not body.exprdirs.shape[2]:
            raise InputError(
                "face of the body",
                expected="expressions, a jaw and eyes",
                received=f"no {', '.join(missing)}" if missing else "no expressions",
            )
        joints = np.asarray(body.rest_joints(BodyParams.rest(betas=0, expressions=0)))[0]
        eyes = joints[[names.index(name) for name in _EYES]]
        apart = float(np.linalg.norm(eyes[0] - eyes[1]))
        weights = body.weights[:, [names.index("head"), names.index("jaw")]]
        front = (weights.sum(axis=1) > 0.8) & (body.v_template[:, 2] > eyes[:, 2].mean() - _BEHIND * apart)
        if body.part_labels.any():
            front &= np.asarray(body.part_labels) == 0  # eyes, teeth and tongue are no skin
        return FaceSurface(
            np.asarray(body.v_template, np.float64)[front],
            np.asarray(body.exprdirs, np.float64)[front],
            weights[front, 1] > 0.5,
            eyes,
        )

    @property
    def apart(self) -> float:
        """Between the eyes, metres."""
        return float(np.linalg.norm(self.eyes[0] - self.eyes[1]))

    @cached_property
    def lips(self) -> Int64[np.ndarray, "P 2"]:
        """Vertices of the lower and the upper lip that meet.

        Raises:
            InputError: no lips are found.
        """
        down, up = np.flatnonzero(self.lower), np.flatnonzero(~self.lower)
        middle = self.eyes.mean(axis=0)
        if len(down) and len(up):
            distance, nearest = cKDTree(self.vertices[up]).query(self.vertices[down])
            here = self.vertices[down]
            ahead = np.abs(here[:, 0] - middle[0]) < _BESIDE * self.apart
            close = ahead & (distance < _LIPS) & (here[:, 1] < middle[1] - 0.5 * self.apart)
            if close.any():
                close &= here[:, 2] > here[close, 2].max() - _DEEP
                return np.stack([down[close], up[nearest[close]]], axis=1)
        raise InputError("face of the body", expected="lips that meet at rest", received="none")

    @property
    def mouth(self) -> Float64[np.ndarray, " 3"]:
        """The middle of the lips."""
        points = self.vertices[self.lips].reshape(-1, 3)
        return 0.5 * (points.min(axis=0) + points.max(axis=0))


@dataclass(frozen=True, eq=False)
class SolvedBasis:
    """ARKit's expressions as a body's own.

    Attributes:
        coefficients: of each of `ARKIT` at 1. left: share of its displacement about mouth and eyes that is left.
        gap: metres by which it opens the lips more than it should.
    """

    coefficients: Float64[np.ndarray, "52 E"]
    left: Float64[np.ndarray, " 52"]
    gap: Float64[np.ndarray, " 52"]


def solve_basis(target: FaceSurface, source: FaceSurface, names: tuple[str, ...]) -> SolvedBasis:
    """Return ARKit's expressions on a face, as `source` makes those that it has.

    Args:
        names: of the source's expressions.

    Raises:
        InputError: a face without lips.
    """
    scale, moved = _laid(source, target)
    nearest = np.zeros(len(target.vertices), dtype=np.int64)
    for lower in (False, True):
        here, there = np.flatnonzero(target.lower == lower), np.flatnonzero(source.lower == lower)
        nearest[here] = there[cKDTree(moved[there]).query(target.vertices[here])[1]]
    weight = _weights(target)
    wanted = (source.directions * scale[:, None])[nearest]  # N 3 A
    pairs = target.lips
    opening = target.directions[pairs[:, 1], 1] - target.directions[pairs[:, 0], 1]  # P E
    share = _GAP * np.sqrt(weight.sum() / len(pairs))
    size = np.linalg.norm(target.directions * weight[:, None, None], axis=(0, 1))
    rows = [
        (target.directions * weight[:, None, None]).reshape(-1, target.directions.shape[2]),
        share * opening / np.sqrt(len(pairs)),
        _RIDGE * np.sqrt((size**2).mean()) * np.eye(len(size)),
    ]
    q, r = np.linalg.qr(np.concatenate(rows))
    coefficients = np.zeros((len(ARKIT), len(size)))
    left, gap = np.ones(len(ARKIT)), np.zeros(len(ARKIT))
    for k, name in enumerate(ARKIT):
        if name not in names:
            continue
        goal = wanted[..., names.index(name)]
        parts = goal[pairs[:, 1], 1] - goal[pairs[:, 0], 1]
        right = [(goal * weight[:, None]).ravel(), share * parts / np.sqrt(len(pairs)), np.zeros(len(size))]
        coefficients[k] = lsq_linear(r, q.T @ np.concatenate(right), bounds=(-_MOST, _MOST)).x
        off = (target.directions @ coefficients[k] - goal) * weight[:, None]
        left[k] = np.linalg.norm(off) / max(float(np.linalg.norm(right[0])), 1e-9)
        gap[k] = float((opening @ coefficients[k] - parts).mean())
    return SolvedBasis(coefficients, left, gap)


def numbered_basis(body: BodyModel) -> SolvedBasis:
    """Return ARKit's expressions on any body with a face, as the embedded body makes them.

    Raises:
        InputError: a body without expressions, jaw, eyes or lips.
    """
    open_body = load_body()
    return solve_basis(FaceSurface.of(body), FaceSurface.of(open_body), tuple(open_body.expression_names))


def _laid(source: FaceSurface, target: FaceSurface) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, "N 3"]]:
    """The source's scale along the axes and its vertices, laid over the target by eyes and mouth."""
    frames = []
    for face in (source, target):
        eyes = face.eyes.mean(axis=0)
        frames.append((eyes, np.array([face.apart, eyes[1] - face.mouth[1]])))
    (here, size), (there, goal) = frames
    across, up = goal / size
    scale = np.array([across, up, np.sqrt(across * up)])
    mouth = source.mouth
    # In depth the mouths meet: eyes lie deep in some heads and shallow in others.
    moved = (source.vertices - here) * scale + there
    return scale, moved + [0.0, 0.0, target.mouth[2] - ((mouth - here) * scale + there)[2]]


def _weights(face: FaceSurface) -> Float64[np.ndarray, " N"]:
    """How much a vertex counts: mouth and eyes."""
    out = np.full(len(face.vertices), _ELSEWHERE)
    for place, reach in ((face.mouth, _NEAR["mouth"]), *((eye, _NEAR["eyes"]) for eye in face.eyes)):
        away = np.linalg.norm((face.vertices - place)[:, :2], axis=1) / (reach * face.apart)
        out = np.maximum(out, np.exp(-0.5 * (away / 0.6) ** 2))
    return out
