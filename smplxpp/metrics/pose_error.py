"""How far estimated poses are from the true ones: the body's surface, its joints, their rotations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.body import BodyModel, PosedBody
from smplxpp.core import BodyParams, InputError
from smplxpp.metrics.comparison import MM

CONVENTION = (
    "mean distance of body vertices with the estimated parameters from the same with the exact ones, nothing aligned: "
    "of all, of those in the open (bare skin) and of those that a part covers (under cloth); of joints; mean angle "
    "between the rotations of a joint relative to its parent. Mean over frames."
)


@dataclass(frozen=True)
class PoseError:
    """Errors of some frames, each the mean over frames.

    Attributes:
        frames: their number.
        body_mm, bare_mm, covered_mm: of the body's vertices: all, those in the open, those that a part covers; NaN
            where there are none.
        joints_mm: of the joints.
        degrees: between local rotations of a joint, a joint.
    """

    frames: int
    body_mm: float
    bare_mm: float
    covered_mm: float
    joints_mm: float
    degrees: float


def pose_error(found: BodyParams, exact: BodyParams, body: BodyModel, covered: Bool[np.ndarray, " V"]) -> PoseError:
    r"""Compare parameters of the same frames.

    With x_v(p) the posed vertices of the whole model, shape included, and R_j(p) the rotation of joint j relative to
    its parent (the root's is in the world):

    `d = mean_{t,v} |x_v(found_t) - x_v(exact_t)|` over the vertices v of a set, likewise over joints, and
    `a = mean_{t,j} arccos((tr(R_j(found_t)^T R_j(exact_t)) - 1) / 2)`, the geodesic angle.

    Args:
        found: T frames; it may have more or fewer shape coefficients than `exact`.
        exact: T frames.
        body: the model that both are for.
        covered: whether a part covers a vertex of the body.

    Raises:
        InputError: different numbers of frames, or a mask of another body.
    """
    if len(found) != len(exact):
        raise InputError(
            "poses to compare", expected=f"{len(exact)} frames, as the exact ones", received=str(len(found))
        )
    if covered.shape != (body.vertex_count,):
        raise InputError(
            "covered vertices", expected=f"one value for each of {body.vertex_count}", received=f"shape {covered.shape}"
        )
    return mean_pose_error([_of_frame(found.frame(t), exact.frame(t), body, covered) for t in range(len(exact))])


def mean_pose_error(errors: Sequence[PoseError]) -> PoseError:
    """The errors of all frames of several errors, each counted by its frames.

    Raises:
        InputError: none.
    """
    frames = np.array([error.frames for error in errors])
    if not frames.sum():
        raise InputError("poses to compare", expected="at least one frame", received="none")
    names = ("body_mm", "bare_mm", "covered_mm", "joints_mm", "degrees")
    means = {name: float(np.average([getattr(e, name) for e in errors], weights=frames)) for name in names}
    return PoseError(frames=int(frames.sum()), **means)


def _of_frame(found: BodyParams, exact: BodyParams, body: BodyModel, covered: np.ndarray) -> PoseError:
    ours, true = body.forward(found), body.forward(exact)
    away = MM * np.linalg.norm(ours.vertices - true.vertices, axis=-1)[0]
    rotations = [_local_rotations(posed, body) for posed in (ours, true)]
    # |R - Q|_F = 2 sqrt(2) sin(angle / 2): exact near zero, where the arc cosine of a trace is not.
    chord = np.linalg.norm(rotations[0] - rotations[1], axis=(-2, -1)) / (2.0 * np.sqrt(2.0))
    return PoseError(
        frames=1,
        body_mm=float(away.mean()),
        bare_mm=_mean(away[~covered]),
        covered_mm=_mean(away[covered]),
        joints_mm=float(MM * np.linalg.norm(ours.joints - true.joints, axis=-1).mean()),
        degrees=float(np.degrees(2.0 * np.arcsin(np.clip(chord, 0.0, 1.0))).mean()),
    )


def _local_rotations(posed: PosedBody, body: BodyModel) -> Float64[np.ndarray, "J 3 3"]:
    """Rotations of the joints relative to their parents, hands given as PCA coefficients included."""
    world = posed.posed_from_rest[0, :, :3, :3]
    parents = np.asarray(body.parents)
    local = world.copy()
    child = parents >= 0
    local[child] = np.swapaxes(world[parents[child]], -1, -2) @ world[child]
    return local


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")
