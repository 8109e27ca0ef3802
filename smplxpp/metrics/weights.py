"""Skinning weights: are they weights at all, how many joints a vertex, how far from a reference, how smooth."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float64, Integer

from smplxpp.core import InputError, WeightsLike, dense_weights


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


def _dense(weights: WeightsLike, name: str) -> np.ndarray:
    dense = dense_weights(weights)
    if dense.ndim != 2 or not dense.size or not np.isfinite(dense).all():
        raise InputError(name, expected="finite values of shape (N, J)", received=f"shape {dense.shape} or NaN")
    return dense


def _variation_stats(values: np.ndarray) -> VariationStats:
    p95, p99 = np.percentile(values, (95, 99))
    return VariationStats(float(values.mean()), float(p95), float(p99), float(values.max()))
