"""Displacements of new poses: a low-rank linear regression from the pose (`training.student.regress_poses` fits it)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.rig.rig import THETA


class PoseRegression(nn.Module):
    """`dv(theta) = m + B A (clip(theta, low, high) - c)`, linear in the pose as SMPL's pose correctives.

    Angles are clamped to a range about the training's, because a linear function does not extrapolate.

    Args:
        level: m, mean displacement, metres along the canonical axes.
        basis: B, metres.
        rows: A, 1 / radian.
        center: c, radians.
        low: least angles, radians.
        high: largest angles, radians.
    """

    level: Tensor
    basis: Tensor
    rows: Tensor
    center: Tensor
    low: Tensor
    high: Tensor

    def __init__(
        self,
        level: Float[Tensor, "K 3"],
        basis: Float[Tensor, "K 3 r"],
        rows: Float[Tensor, "r 63"],
        center: Float[Tensor, " 63"],
        low: Float[Tensor, " 63"],
        high: Float[Tensor, " 63"],
    ) -> None:
        super().__init__()
        given = {"level": level, "basis": basis, "rows": rows, "center": center, "low": low, "high": high}
        for name, value in given.items():
            self.register_buffer(name, value.detach().to(torch.float32, copy=True))

    @staticmethod
    def shapes(points: int, directions: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the arguments by name."""
        basis = {"level": (points, 3), "basis": (points, 3, directions), "rows": (directions, THETA)}
        return basis | dict.fromkeys(("center", "low", "high"), (THETA,))

    def forward(self, pose: Float[Tensor, "B 63"]) -> Float[Tensor, "B K 3"]:
        """Return displacements of the points in B poses, metres."""
        turned = torch.minimum(torch.maximum(pose, self.low), self.high) - self.center
        return self.level + (turned @ self.rows.T @ self.basis.flatten(0, 1).T).unflatten(1, (-1, 3))
