"""Define SkinWeights, which the transfer of skin weights returns and skinning takes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32

from smplxpp.core.errors import InputError


@dataclass(frozen=True, eq=False)
class SkinWeights:
    """Sparse skinning weights of N vertices over J joints, with their provenance.

    Attributes:
        joint_indices: (N, K) int32.
        joint_weights: (N, K) float64, rows sum to 1, none negative; unused slots have weight 0.
        joint_count: J.
        matched: (N,) bool, taken from the source by correspondence (not inpainted).
        distance: (N,) float64 metres to the closest source point (NaN where unknown).
        angle: (N,) float64 radians between the normals there (NaN where unknown).
        component: (N,) int32 connected component of each vertex.
        policies: the policy taken for each component ("matched", "nearest", "rigid:head", ...).

    Example:
        >>> weights = smplxpp.SkinWeights.from_dense(np.array([[0.25, 0.75], [1.0, 0.0]]))
        >>> weights
        SkinWeights(2 vertices over 2 joints, at most 2 a vertex)
        >>> weights.dense()[0]
        array([0.25, 0.75])
    """

    joint_indices: Int32[np.ndarray, "N K"]
    joint_weights: Float64[np.ndarray, "N K"]
    joint_count: int
    matched: Bool[np.ndarray, " N"]
    distance: Float64[np.ndarray, " N"]
    angle: Float64[np.ndarray, " N"]
    component: Int32[np.ndarray, " N"]
    policies: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.joint_indices)

    def __repr__(self) -> str:
        slots = self.joint_indices.shape[-1]
        return f"SkinWeights({len(self):,} vertices over {self.joint_count} joints, at most {slots} a vertex)"

    def dense(self) -> Float64[np.ndarray, "N J"]:
        """Return the weights of all joints; every row sums to 1."""
        out = np.zeros((len(self), self.joint_count))
        np.add.at(out, (np.arange(len(self))[:, None], self.joint_indices), self.joint_weights)
        return out

    @staticmethod
    def from_dense(
        weights: Float[np.ndarray, "N J"], *, max_influences: int | None = None, **provenance
    ) -> SkinWeights:
        """Keep the `max_influences` largest of each row of (N, J) weights, clip at 0, renormalise.

        Raises:
            InputError: a row without a positive weight, or NaN.
        """
        weights = np.asarray(weights, dtype=np.float64)
        if weights.ndim != 2 or not np.isfinite(weights).all():
            raise InputError("skinning weights", expected="finite (N, J)", received=f"shape {weights.shape} or NaN")
        n, joint_count = weights.shape
        # Negative weights are round-off of solvers.
        clipped = np.clip(weights, 0.0, None)
        # No row needs more slots than its number of positive weights.
        used = int((clipped > 0).sum(axis=1).max(initial=1))
        k = max(1, min(used, max_influences or joint_count))
        # Stable order: larger weight first, then lower joint index. Joints without any weight are not sorted, unless
        # they have to fill slots of weight 0.
        joints = np.flatnonzero(clipped.any(axis=0)) if n else np.arange(joint_count)
        joints = joints if len(joints) >= k else np.arange(joint_count)
        order = joints[np.argsort(-clipped[:, joints], axis=1, kind="stable")[:, :k]]
        # (N, k) weights in the order of `order`; dividing by their sum keeps the partition of unity.
        kept = np.take_along_axis(clipped, order, axis=1)
        total = kept.sum(axis=1, keepdims=True)
        if (total <= 0).any():
            raise InputError(
                "skinning weights",
                expected="a positive weight in every row",
                received=f"{int((total <= 0).sum())} rows without, first at vertex {int(np.argmax(total <= 0))}",
            )
        defaults = {
            "matched": np.ones(n, dtype=bool),
            "distance": np.full(n, np.nan),
            "angle": np.full(n, np.nan),
            "component": np.zeros(n, dtype=np.int32),
            "policies": (),
        }
        return SkinWeights(order.astype(np.int32), kept / total, joint_count, **{**defaults, **provenance})
