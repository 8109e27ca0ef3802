"""Skinning weights: are they weights at all, how many joints a vertex, how far from a reference, how smooth; rigs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Integer

from smplxpp.core import InputError, WeightsLike, dense_weights
from smplxpp.core.mesh_files.raw_mesh import FileRig


@dataclass(frozen=True)
class VariationStats:
    """Statistics of total variation, in [0, 1] for rows that sum to 1."""

    mean: float
    p95: float
    p99: float
    max: float


@dataclass(frozen=True)
class WeightReport:
    """Figures of skin weights, as `weight_report` measures them.

    Attributes:
        vertex_count, joint_count: N, J.
        row_sum_error: largest |sum of a row - 1|.
        negative: number of negative weights.
        minimum: the smallest weight.
        zero_rows: vertices without any weight; they would stay at the origin without a word.
        influences: influences[k] vertices have k joints with a weight above 0.
        reference: total variation to the reference weights, or None.
        edges: total variation along mesh edges (smoothness), or None.
    """

    vertex_count: int
    joint_count: int
    row_sum_error: float
    negative: int
    minimum: float
    zero_rows: int
    influences: tuple[int, ...]
    reference: VariationStats | None = None
    edges: VariationStats | None = None

    @property
    def valid(self) -> bool:
        """Rows sum to 1 within 1e-9, none negative, none empty."""
        return self.row_sum_error <= 1e-9 and not self.negative and not self.zero_rows

    def as_dict(self) -> dict:
        """Return the figures as plain numbers for JSON."""
        return {**asdict(self), "valid": self.valid}


def total_variation(a: WeightsLike, b: WeightsLike) -> Float64[np.ndarray, " N"]:
    """Half the L1 distance of two rows of weights: the share of a vertex that follows other joints."""
    return 0.5 * np.abs(dense_weights(a) - dense_weights(b)).sum(axis=1)


def weight_report(
    weights: WeightsLike,
    *,
    reference: WeightsLike | None = None,
    edges: Integer[np.ndarray, "E 2"] | None = None,
) -> WeightReport:
    """Check skinning weights (N, J) and measure them against a reference (N, J) and along edges (E, 2).

    Raises:
        InputError: NaN, other shapes, no vertices, or edge indices out of range.
    """
    dense = _dense(weights, "skinning weights")
    count, joints = dense.shape
    # Total variation against the reference, vertex by vertex: the share of weight that lies on other joints.
    variation = None
    if reference is not None:
        truth = _dense(reference, "reference weights")
        if truth.shape != dense.shape:
            raise InputError("reference weights", expected=f"shape {dense.shape}", received=f"shape {truth.shape}")
        variation = _variation_stats(total_variation(dense, truth))
    # Total variation along the edges measures smoothness: neighbours should follow nearly the same joints.
    along = None
    if edges is not None:
        edges = np.asarray(edges)
        integers = np.issubdtype(edges.dtype, np.integer)
        if edges.ndim != 2 or edges.shape[1:] != (2,) or not len(edges) or not integers:
            raise InputError(
                "edges", expected="integers of shape (E, 2)", received=f"{edges.dtype} of shape {edges.shape}"
            )
        if edges.min() < 0 or edges.max() >= count:
            raise InputError(
                "edges", expected=f"indices in [0, {count})", received=f"indices in [{edges.min()}, {edges.max()}]"
            )
        along = _variation_stats(total_variation(dense[edges[:, 0]], dense[edges[:, 1]]))
    # Skinning is an affine combination of joint transforms only if each row sums to 1.
    sums = dense.sum(axis=1)
    return WeightReport(
        vertex_count=count,
        joint_count=joints,
        row_sum_error=float(np.abs(sums - 1.0).max()),
        negative=int((dense < 0).sum()),
        minimum=float(dense.min()),
        zero_rows=int((~dense.any(axis=1)).sum()),
        influences=tuple(np.bincount((dense > 0).sum(axis=1)).tolist()),
        reference=variation,
        edges=along,
    )


def rig_report(rig: FileRig) -> tuple[dict[str, Any], dict[str, Bool[np.ndarray, " N"]]]:
    """Check the skeleton and the skin weights of a file, as it stores them.

    Returns:
        Figures: `joints`, `roots` (joints without one above), `moving` (joints with a weight), `influences` (most
        joints of a vertex), `sum_error` (largest |sum of a vertex's weights - 1|, of vertices with any),
        `singular_binds` (inverse bind matrices without an inverse, with NaN, or with a last row that is not 0 0 0 1).
        The vertices with each fault, by its name.

    Example:
        >>> from smplxpp.core.mesh_files.raw_mesh import FileRig
        >>> one, columns = np.eye(4)[None], np.zeros((2, 1), dtype=np.int64)
        >>> rig = FileRig(
        ...     names=("root",),
        ...     parents=np.array([-1]),
        ...     world=one,
        ...     column_joint=np.zeros(1, dtype=np.int64),
        ...     inverse_bind=one,
        ...     columns=columns,
        ...     weights=np.array([[1.0], [0.0]]),
        ...     bound=np.zeros((2, 3)),
        ... )
        >>> figures, faults = rig_report(rig)
        >>> figures["joints"], faults["vertices without weights"].tolist()
        (1, [False, True])
    """
    weights, held = rig.weights, rig.weights != 0
    total = weights.sum(axis=1)
    # Columns of one vertex in order; what follows itself with a weight is there twice.
    joint = np.where(held, rig.column_joint[rig.columns], -1)
    ordered = np.sort(joint, axis=1)
    twice = ((ordered[:, 1:] == ordered[:, :-1]) & (ordered[:, 1:] >= 0)).any(axis=1)
    moved = held.any(axis=1)
    finite = np.isfinite(rig.inverse_bind).all(axis=(1, 2))
    binds = np.where(finite[:, None, None], rig.inverse_bind, 0.0)
    # Relative to the size of the matrix, because bones of a file in millimetres are scaled by a thousandth.
    size = np.abs(binds[:, :3, :3]).max(axis=(1, 2))
    flat = np.abs(np.linalg.det(binds[:, :3, :3])) <= 1e-9 * size**3
    affine = np.abs(binds[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) < 1e-4
    off = np.where(moved, np.abs(total - 1.0), 0.0)
    faults = {
        "vertices without weights": ~moved | ~(total > 0),
        "negative weights": (weights < 0).any(axis=1),
        "weights off a sum of 1": off > 0.01,
        "a joint twice at a vertex": twice,
    }
    figures = {
        "joints": len(rig.names),
        "roots": int((rig.parents < 0).sum()),
        "moving": len(np.unique(joint[held])),
        "influences": int(held.sum(axis=1).max(initial=0)),
        "sum_error": float(off.max(initial=0.0)),
        "singular_binds": int((~finite | flat | ~affine).sum()),
    }
    return figures, faults


def _dense(weights: WeightsLike, name: str) -> np.ndarray:
    dense = dense_weights(weights)
    if dense.ndim != 2 or not dense.size or not np.isfinite(dense).all():
        raise InputError(name, expected="finite values of shape (N, J)", received=f"shape {dense.shape} or NaN")
    return dense


def _variation_stats(values: np.ndarray) -> VariationStats:
    p95, p99 = np.percentile(values, (95, 99))
    return VariationStats(float(values.mean()), float(p95), float(p99), float(values.max()))
