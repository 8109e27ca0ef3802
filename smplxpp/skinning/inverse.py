"""Skin rest points to a pose, and invert exactly that map to bring posed points back to the rest pose."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy.typing import ArrayLike

from smplxpp.core import GeometryWarning, InputError, PointsLike, SkinWeights, WeightsLike, as_array, dense_weights
from smplxpp.core.errors import one_line
from smplxpp.core.foreign import point_arrays
from smplxpp.skinning.linear_blend import blend_transforms, skin


@dataclass(frozen=True)
class UnposeConfig:
    """Bounds on the determinant of a blended transform, which is 1 if one joint has all the weight.

    An even blend of two joints has 0.5 at 90 degrees between them, 0.25 at 120, 0.067 at 150 and 0 at 180, where linear
    blend skinning folds the surface flat and has no inverse.

    Attributes:
        warn_below: determinant below which vertices are counted in a warning.
        fail_below: determinant below which an error names the vertices.
    """

    warn_below: float = 0.25
    fail_below: float = 0.05


@dataclass(frozen=True)
class UnposeReport:
    """Conditioning and accuracy of an inversion.

    Attributes:
        determinant_min: smallest determinant over the vertices.
        determinant_mean: mean determinant.
        below_warning: number of vertices below `UnposeConfig.warn_below`.
        round_trip_max: largest |pose(unpose(x)) - x|, metres.
    """

    determinant_min: float
    determinant_mean: float
    below_warning: int
    round_trip_max: float


@dataclass(frozen=True, eq=False)
class Unposed:
    """Rest positions that `unpose` returns, with their conditioning.

    Attributes:
        vertices: (N, 3) rest positions, metres.
        determinant: (N,) determinant of the linear part of each vertex's blended transform.
        report: summary.
    """

    vertices: Float64[np.ndarray, "N 3"]
    determinant: Float64[np.ndarray, " N"]
    report: UnposeReport

    __repr__ = one_line


def pose(
    rest_vertices: PointsLike,
    weights: WeightsLike,
    posed_from_rest: ArrayLike,
    *,
    rest_offsets: PointsLike | None = None,
) -> Float64[np.ndarray, "N 3"]:
    """Pose rest points by linear blend skinning, `x = (sum_j w_j G_j) (x_T + b)`.

    Args:
        rest_vertices: (N, 3) x_T, metres.
        weights: skin weights of the N vertices over J joints; dense rows sum to 1.
        posed_from_rest: (J, 4, 4) G, as `BodyModel.forward` returns them for one frame.
        rest_offsets: (N, 3) b, see `unpose`.

    Returns:
        (N, 3) posed positions, metres.

    Raises:
        InputError: shapes that do not fit, NaN, transforms that are not affine.

    Example:
        >>> vertices, weights = np.array([[0.0, 1.0, 0.0]]), np.array([[1.0]])
        >>> moved = np.eye(4)[None] + [[[0, 0, 0, 2], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]]
        >>> smplxpp.pose(vertices, weights, moved)
        array([[2., 1., 0.]])
    """
    rest, dense, transforms, offsets = _checked("rest vertices", rest_vertices, weights, posed_from_rest, rest_offsets)
    return skin(rest + offsets, dense, transforms)


def unpose(
    posed_vertices: PointsLike,
    weights: WeightsLike,
    posed_from_rest: ArrayLike,
    *,
    rest_offsets: PointsLike | None = None,
    config: UnposeConfig | None = None,
) -> Unposed:
    """Invert linear blend skinning, `x_T = (sum_j w_j G_j)^-1 x - b`.

    The inverse is that of the blended matrix, so that `pose` with the same weights and transforms returns the input;
    blending the inverses instead would not. The transforms refer to the joints of the shaped body, so that x_T lies
    around that body's own T-pose; its shape is not removed.

    b is the offset that the driving model adds to the rest position before skinning in this pose: the body's expression
    and pose-corrective offset at the point that the vertex corresponds to (barycentric, as its weights were found).
    Pass it only if the driver will add it again. A `Template` moves its parts by skinning alone, so that parts of one
    are unposed without.

    Args:
        posed_vertices: (N, 3) x, metres.
        weights: skin weights of the N vertices over J joints.
        posed_from_rest: (J, 4, 4) transforms of the pose that x is in.
        rest_offsets: (N, 3) b, metres; None is zero.
        config: bounds on the determinant.

    Raises:
        InputError: as `pose`; a determinant below `config.fail_below`, with the vertices' names.

    Warns:
        GeometryWarning: a determinant below `config.warn_below`.

    Example:
        >>> body = smplxpp.load_body()
        >>> posed = body.forward(smplxpp.load_params("data/fixtures/person/params/params.npz")).frame(0)
        >>> found = smplxpp.unpose(posed.vertices, body.weights, posed.posed_from_rest)
        >>> bool(np.allclose(found.vertices, posed.rest_vertices, atol=1e-9))
        True
    """
    config = config or UnposeConfig()
    posed, dense, transforms, offsets = _checked(
        "posed vertices", posed_vertices, weights, posed_from_rest, rest_offsets
    )
    # The blended transform of each vertex; a small determinant magnifies errors, 0 cannot be inverted.
    blended = blend_transforms(dense, transforms)
    linear, shift = blended[:, :3, :3], blended[:, :3, 3]
    determinant = np.linalg.det(linear)
    low = np.flatnonzero(determinant < config.fail_below)
    if len(low):
        named = ", ".join(f"{v} ({determinant[v]:.3g})" for v in low[:8])
        raise InputError(
            "blended transforms",
            expected=f"determinants of at least {config.fail_below:g}",
            received=f"{len(low)} vertices below: {named}{', ...' if len(low) > 8 else ''}",
            remedy="choose a reference frame nearer to the T-pose, or smooth the weights of these vertices",
        )
    weak = int((determinant < config.warn_below).sum())
    if weak:
        warnings.warn(
            f"{weak} of {len(posed)} vertices are bent so far that unposing magnifies their errors "
            f"(determinant down to {determinant.min():.3g})",
            GeometryWarning,
            stacklevel=2,
        )
    # Solve for the rest positions, and pose them again to measure the error.
    shaped = np.linalg.solve(linear, (posed - shift)[..., None])[..., 0]
    round_trip = np.linalg.norm(skin(shaped, dense, transforms) - posed, axis=1)
    report = UnposeReport(
        determinant_min=float(determinant.min(initial=np.inf)),
        determinant_mean=float(determinant.mean()) if len(determinant) else float("nan"),
        below_warning=weak,
        round_trip_max=float(round_trip.max(initial=0.0)),
    )
    return Unposed(shaped - offsets, determinant, report)


def invertible_weights(
    weights: SkinWeights, posed_from_rest: Float[np.ndarray, "J 4 4"], *, least: float = 0.05
) -> tuple[SkinWeights, Bool[np.ndarray, " N"]]:
    """Move the weights of folded vertices towards their strongest joint until their transforms can be inverted.

    A row w becomes `(1 - t) w + t e`, with e the joint of the largest weight and the smallest t of 0.05, 0.1, ..., 1
    whose blended transform has a determinant of at least `least`; with t = 1 it is a rotation, whose determinant is 1.

    Args:
        weights: skin weights of N vertices over J joints.
        posed_from_rest: (J, 4, 4) transforms of the pose that the vertices are in.
        least: determinant.

    Returns:
        The weights, the same object where nothing was to do, and the vertices (N,) that were changed.

    Example:
        >>> turned = np.stack([np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])])
        >>> even = smplxpp.SkinWeights.from_dense(np.array([[0.5, 0.5], [0.0, 1.0]]))
        >>> found, changed = smplxpp.skinning.invertible_weights(even, turned)
        >>> changed.tolist(), found.dense()[0].round(2).tolist()
        ([True, False], [0.65, 0.35])
    """
    dense = weights.dense()
    changed = np.linalg.det(blend_transforms(dense, posed_from_rest)[:, :3, :3]) < least
    if not changed.any():
        return weights, changed
    rows = np.flatnonzero(changed)
    strongest = np.zeros((len(rows), weights.joint_count))
    strongest[np.arange(len(rows)), dense[rows].argmax(axis=1)] = 1.0
    left = np.ones(len(rows), dtype=bool)
    for t in np.linspace(0.05, 1.0, 20):
        mixed = (1.0 - t) * dense[rows] + t * strongest
        done = left & (np.linalg.det(blend_transforms(mixed, posed_from_rest)[:, :3, :3]) >= least)
        dense[rows[done]] = mixed[done]
        left &= ~done
    kept = {name: getattr(weights, name) for name in ("matched", "distance", "angle", "component", "policies")}
    return SkinWeights.from_dense(dense, max_influences=weights.joint_indices.shape[1], **kept), changed


def _checked(subject, vertices, weights, posed_from_rest, rest_offsets):
    """Return vertices, dense weights, transforms and offsets in float64 after checking shapes, sums and finiteness."""
    vertices, _ = point_arrays(vertices)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices) or not np.isfinite(vertices).all():
        raise InputError(subject, expected="finite (N, 3), N > 0", received=_describe(vertices))
    # Vertices and weights: finite, of matching lengths.
    dense = dense_weights(weights)
    if dense.ndim != 2 or len(dense) != len(vertices) or not np.isfinite(dense).all():
        raise InputError("skinning weights", expected=f"finite ({len(vertices)}, J)", received=_describe(dense))
    # Rows of weights sum to 1, transforms are affine, offsets have the vertices' shape.
    error = np.abs(dense.sum(axis=1) - 1.0)
    if error.max() > 1e-6:
        raise InputError(
            "skinning weights",
            expected="rows that sum to 1",
            received=f"a sum of {dense[np.argmax(error)].sum():.6g} at vertex {int(np.argmax(error))}",
            remedy="normalise them, for instance with SkinWeights.from_dense",
        )
    # Transforms: one affine matrix for each joint. Transposed matrices have other last rows.
    transforms = np.asarray(as_array(posed_from_rest), dtype=np.float64)
    if transforms.shape != (dense.shape[1], 4, 4) or not np.isfinite(transforms).all():
        raise InputError(
            "posed_from_rest", expected=f"finite ({dense.shape[1]}, 4, 4): one frame", received=_describe(transforms)
        )
    if not np.array_equal(transforms[:, 3], np.broadcast_to([0.0, 0.0, 0.0, 1.0], (len(transforms), 4))):
        raise InputError(
            "posed_from_rest", expected="last rows 0 0 0 1", received="others", remedy="check for transposed matrices"
        )
    offsets = np.zeros((1, 3)) if rest_offsets is None else point_arrays(rest_offsets)[0]
    if rest_offsets is not None and (offsets.shape != vertices.shape or not np.isfinite(offsets).all()):
        raise InputError("rest offsets", expected=f"finite {vertices.shape}", received=_describe(offsets))
    return vertices, dense, transforms, offsets


def _describe(array: np.ndarray) -> str:
    return f"shape {array.shape}" + ("" if np.isfinite(array).all() else " with NaN or infinity")
