"""ARKit's blendshapes, and their transfer to a body with numbered expressions (SMPL-X, FLAME) by least squares.

The embedded body has ARKit's blendshapes by name. Its face is aligned with the other one by eyes and mouth, its
displacements t are copied to the nearest vertices (upper lip to upper, lower to lower), and the coefficients c that
reproduce them with the directions D solve `min_c |W (D c - t)|^2 + w |G (D c - t)|^2 + r |c|^2` within bounds. W gives
weight to vertices near mouth and eyes; G is the gap between the lips, so that lips that close on one face close on the
other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.optimize import lsq_linear
from scipy.spatial import cKDTree

from smplxpp.body.loader import load_body
from smplxpp.body.model import BodyModel
from smplxpp.core import BodyParams, InputError

_SIDED = (
    *("eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide", "browDown"),
    *("browOuterUp", "cheekSquint", "noseSneer", "mouthSmile", "mouthFrown", "mouthDimple", "mouthStretch"),
    *("mouthPress", "mouthLowerDown", "mouthUpperUp"),
)
_UNSIDED = (
    *("jawForward", "jawLeft", "jawRight", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft"),
    *("mouthRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "browInnerUp"),
    *("cheekPuff", "tongueOut"),
)
ARKIT: tuple[str, ...] = tuple(sorted([*_UNSIDED, *(f"{name}{side}" for name in _SIDED for side in ("Left", "Right"))]))
"""ARKit's 52 blendshapes by name, in alphabetical order."""
_EYES = ("left_eye_smplhf", "right_eye_smplhf")


@dataclass(frozen=True, eq=False)
class FaceSurface:
    """A face at rest with its body's expression directions.

    Attributes:
        vertices: metres.
        directions: displacements in metres at an expression of 1.
        lower: whether a vertex follows the jaw.
        eyes: centres of rotation of the left and the right eye, metres.
    """

    vertices: Float64[np.ndarray, "N 3"]
    directions: Float64[np.ndarray, "N 3 E"]
    lower: Bool[np.ndarray, " N"]
    eyes: Float64[np.ndarray, "2 3"]

    @staticmethod
    def of(body: BodyModel) -> FaceSurface:
        """Return the front of a body's head: skin from 0.6 eye distances behind the eyes forward.

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
        # The distance between the eyes is the unit of all sizes, so that heads of any size are cut alike.
        joints = np.asarray(body.rest_joints(BodyParams.rest(betas=0, expressions=0)))[0]
        eyes = joints[[names.index(name) for name in _EYES]]
        eye_distance = float(np.linalg.norm(eyes[0] - eyes[1]))
        weights = body.weights[:, [names.index("head"), names.index("jaw")]]
        front = (weights.sum(axis=1) > 0.8) & (body.v_template[:, 2] > eyes[:, 2].mean() - 0.6 * eye_distance)
        front &= body.outer_skin
        return FaceSurface(
            np.asarray(body.v_template, np.float64)[front],
            np.asarray(body.exprdirs, np.float64)[front],
            weights[front, 1] > 0.5,
            eyes,
        )

    @property
    def eye_distance(self) -> float:
        """The distance between the eyes, metres."""
        return float(np.linalg.norm(self.eyes[0] - self.eyes[1]))

    @cached_property
    def lips(self) -> Int64[np.ndarray, "P 2"]:
        """Pairs of vertices of the lower and the upper lip that meet at rest.

        Raises:
            InputError: no lips are found.
        """
        # Sizes of an adult's face: lips that meet are within 7 mm of each other, within 0.55 eye distances of the
        # middle, below the eyes, and at most 2 cm behind the foremost pair, which leaves out the inside of the mouth.
        down, up = np.flatnonzero(self.lower), np.flatnonzero(~self.lower)
        middle = self.eyes.mean(axis=0)
        if len(down) and len(up):
            distance, nearest = cKDTree(self.vertices[up]).query(self.vertices[down])
            here = self.vertices[down]
            ahead = np.abs(here[:, 0] - middle[0]) < 0.55 * self.eye_distance
            close = ahead & (distance < 0.007) & (here[:, 1] < middle[1] - 0.5 * self.eye_distance)
            if close.any():
                close &= here[:, 2] > here[close, 2].max() - 0.02
                return np.stack([down[close], up[nearest[close]]], axis=1)
        raise InputError("face of the body", expected="lips that meet at rest", received="none")

    @property
    def mouth(self) -> Float64[np.ndarray, " 3"]:
        """The centre of the lips, metres."""
        # Middle of the box around the pairs, because dense triangulation would pull a mean of the vertices to one
        # side.
        points = self.vertices[self.lips].reshape(-1, 3)
        return 0.5 * (points.min(axis=0) + points.max(axis=0))


@dataclass(frozen=True, eq=False)
class BlendshapeSolution:
    """ARKit's blendshapes as combinations of a body's own expressions.

    Attributes:
        coefficients: expressions of each of `ARKIT` at 1.
        residual: norm of the unexplained displacement about mouth and eyes, relative to the displacement's.
        gap_error: excess of the gap between the lips, metres.
    """

    coefficients: Float64[np.ndarray, "52 E"]
    residual: Float64[np.ndarray, " 52"]
    gap_error: Float64[np.ndarray, " 52"]


def solve_blendshapes(target: FaceSurface, source: FaceSurface, names: tuple[str, ...]) -> BlendshapeSolution:
    """Solve for ARKit's blendshapes on a face; those that the source does not have are 0.

    Args:
        target: the face with numbered expressions.
        source: a face whose expressions are ARKit's.
        names: names of the source's expressions.

    Raises:
        InputError: a face without lips.
    """
    max_coefficient = 3.0  # standard deviations: such models are trained on few faces outside
    gap_weight, ridge_weight = 4.0, 0.02  # relative to a vertex's weight of 1
    # Displacements of the source at the nearest vertex, with its scale.
    scale, moved = _align_faces(source, target)
    nearest = np.zeros(len(target.vertices), dtype=np.int64)
    for lower in (False, True):
        here, there = np.flatnonzero(target.lower == lower), np.flatnonzero(source.lower == lower)
        nearest[here] = there[cKDTree(moved[there]).query(target.vertices[here])[1]]
    weight = _vertex_weights(target)
    wanted = (source.directions * scale[:, None])[nearest]  # N 3 A
    # Rows of the system: weighted displacements, gaps of the lips, and the ridge.
    pairs = target.lips
    opening = target.directions[pairs[:, 1], 1] - target.directions[pairs[:, 0], 1]  # P E
    share = gap_weight * np.sqrt(weight.sum() / len(pairs))
    size = np.linalg.norm(target.directions * weight[:, None, None], axis=(0, 1))
    rows = [
        (target.directions * weight[:, None, None]).reshape(-1, target.directions.shape[2]),
        share * opening / np.sqrt(len(pairs)),
        ridge_weight * np.sqrt((size**2).mean()) * np.eye(len(size)),
    ]
    # One QR decomposition serves all right-hand sides.
    q, r = np.linalg.qr(np.concatenate(rows))
    coefficients = np.zeros((len(ARKIT), len(size)))
    residual, gap_error = np.ones(len(ARKIT)), np.zeros(len(ARKIT))
    for k, name in enumerate(ARKIT):
        if name not in names:
            continue
        # |A c - b|^2 with A = Q R has the minimum of |R c - Q^T b|^2 within the same bounds, a system of E rows
        # alone.
        goal = wanted[..., names.index(name)]
        parts = goal[pairs[:, 1], 1] - goal[pairs[:, 0], 1]
        right = [(goal * weight[:, None]).ravel(), share * parts / np.sqrt(len(pairs)), np.zeros(len(size))]
        coefficients[k] = lsq_linear(r, q.T @ np.concatenate(right), bounds=(-max_coefficient, max_coefficient)).x
        off = (target.directions @ coefficients[k] - goal) * weight[:, None]
        residual[k] = np.linalg.norm(off) / max(float(np.linalg.norm(right[0])), 1e-9)
        gap_error[k] = float((opening @ coefficients[k] - parts).mean())
    return BlendshapeSolution(coefficients, residual, gap_error)


def transfer_blendshapes(body: BodyModel) -> BlendshapeSolution:
    """Transfer ARKit's blendshapes from the embedded body to any body with a face.

    Raises:
        InputError: a body without expressions, jaw, eyes or lips.
    """
    open_body = load_body()
    return solve_blendshapes(FaceSurface.of(body), FaceSurface.of(open_body), tuple(open_body.expression_names))


def with_arkit_names(body: BodyModel) -> BodyModel:
    """Return a body whose expressions are numbered with ARKit's after its own, those that its own come near to.

    Near: what is missing has at most half of the displacement's norm about mouth and eyes. Of 20 principal directions
    of faces drawn at random that are 30 of 52, of 50 all but the tongue's. A body with names, or without expressions,
    jaw, eyes or lips, is returned as it is.

    Example:
        >>> from smplxpp.body.blendshapes import with_arkit_names
        >>> with_arkit_names(smplxpp.load_body()).num_expressions
        52
    """
    farthest = 0.5
    if set(ARKIT) & set(body.expression_names):
        return body
    try:
        solved = transfer_blendshapes(body)
    except InputError:
        return body
    near = [k for k in range(len(ARKIT)) if solved.residual[k] <= farthest and solved.coefficients[k].any()]
    return replace(
        body,
        exprdirs=np.concatenate([body.exprdirs, body.exprdirs @ solved.coefficients[near].T], axis=2),
        expression_names=(*body.expression_names, *(ARKIT[k] for k in near)),
    )


def _align_faces(
    source: FaceSurface, target: FaceSurface
) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, "N 3"]]:
    """Return the source's scale along the axes and its vertices, aligned with the target by eyes and mouth."""
    frames = []
    for face in (source, target):
        eyes = face.eyes.mean(axis=0)
        frames.append((eyes, np.array([face.eye_distance, eyes[1] - face.mouth[1]])))
    (here, size), (there, goal) = frames
    # Width scales by the eyes' distance, height by the distance of eyes and mouth, depth by their geometric mean.
    across, up = goal / size
    scale = np.array([across, up, np.sqrt(across * up)])
    mouth = source.mouth
    # Align depth by the mouths, because eyes lie deep in some heads and shallow in others.
    moved = (source.vertices - here) * scale + there
    return scale, moved + [0.0, 0.0, target.mouth[2] - ((mouth - here) * scale + there)[2]]


def _vertex_weights(face: FaceSurface) -> Float64[np.ndarray, " N"]:
    """Return weights of the vertices: Gaussians about mouth and eyes, 0.2 elsewhere."""
    out = np.full(len(face.vertices), 0.2)
    for place, reach in ((face.mouth, 1.0), *((eye, 0.45) for eye in face.eyes)):
        # Distance in the frontal plane (x, y), in units of the eyes' distance.
        away = np.linalg.norm((face.vertices - place)[:, :2], axis=1) / (reach * face.eye_distance)
        out = np.maximum(out, np.exp(-0.5 * (away / 0.6) ** 2))
    return out


def both_sides(name: str) -> tuple[str, ...]:
    """Return the blendshapes of `ARKIT` that a name without its side stands for.

    Example:
        >>> from smplxpp.body.blendshapes import both_sides
        >>> both_sides("mouthSmile")
        ('mouthSmileLeft', 'mouthSmileRight')
    """
    return (name,) if name in ARKIT else (f"{name}Left", f"{name}Right")
