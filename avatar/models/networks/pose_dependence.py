"""Dependence on the pose with few training poses: joints near a vertex, a gate, and a regression for new poses."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from avatar.rig.rig import THETA
from smplxpp.template.template import Template

MIN_SKIN_WEIGHT = 0.05
"""Least skin weight with which a joint carries a vertex."""
BODY_JOINTS = 21
"""Number of joints in theta: joints 1 to 21 of the skeleton."""


def seen_joints(template: Template, steps: int) -> Bool[np.ndarray, "V 21"]:
    """Mark, for each vertex, the joints of theta within `steps` of one that carries the vertex, along the skeleton.

    With few training poses, a skirt would overfit to the arms of those poses. Saito et al., "SCANimate" (2021), mask
    the pose by skin weights for the same reason.
    """
    return joint_steps(template) <= steps


def joint_steps(template: Template) -> Int64[np.ndarray, "V 21"]:
    """Count, for each vertex, the steps from each joint of theta to the nearest joint with skin weight on it."""
    parents = np.asarray(template.body.parents)
    # Steps between two joints: the powers of the skeleton's adjacency reach one step further each (breadth-first).
    near = np.eye(len(parents), dtype=bool)
    children = np.flatnonzero(parents >= 0)
    near[children, parents[children]] = near[parents[children], children] = True
    reached, between = np.eye(len(parents), dtype=bool), np.full((len(parents), len(parents)), len(parents))
    for count in range(len(parents)):
        between = np.where(reached, np.minimum(between, count), between)
        reached = reached @ near
    # The nearest carrying joint counts. Few joints carry a vertex, so that this visits each joint's vertices alone.
    seen = template.weights.dense() > MIN_SKIN_WEIGHT
    steps = np.full(seen.shape, len(parents))
    for joint, carried in enumerate(seen.T):
        rows = np.flatnonzero(carried)
        steps[rows] = np.minimum(steps[rows], between[joint])
    # theta leaves out the root (joint 0) and the joints of face and hands.
    return steps[:, 1 : BODY_JOINTS + 1].astype(np.int64)


class PoseGate(nn.Module):
    """`g(theta) = exp(-((d - d_0) / d_0)^2 / 2)` for d > d_0, else 1, with d the distance to the nearest known pose.

    d_0 is a third of the median distance of a known pose to its nearest other one: halfway between two consecutive
    frames g is 0.88, and a frame's step after the last 0.14. What shapes learn of a frame holds between frames, and
    does not extrapolate: a shirt ten frames a second gets waves and a collar in the neck one step after training.

    Args:
        poses: theta of the training frames, radians.
    """

    poses: Tensor
    scale: Tensor

    def __init__(self, poses: Float[Tensor, "T 63"]) -> None:
        super().__init__()
        self.register_buffer("poses", poses.detach().clone())
        # Distances between the vectors theta, radians; a pose is not its own neighbour.
        apart = torch.cdist(poses.double(), poses.double())
        apart.fill_diagonal_(float("inf"))
        nearest = apart.min(dim=1).values
        near = nearest[nearest.isfinite()]
        least_scale = 0.035  # radians, two degrees of one joint, for a single pose or copies of one
        scale = max(float(near.median()) / 3.0 if len(near) else 0.0, least_scale)
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float32))

    def forward(self, pose: Float[Tensor, " 63"]) -> Float[Tensor, ""]:
        """Return the weight g of a pose, in [0, 1]."""
        distance = (self.poses - pose).norm(dim=1).min()
        # Half a Gaussian: 1 up to d_0, then falling with deviation d_0.
        over = ((distance - self.scale) / self.scale).clamp(min=0.0)
        return torch.exp(-0.5 * over.square())


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
        # (B, 63) clamped angles about the centre, then two products of rank r: (B, r) and (B, 3 K).
        turned = torch.minimum(torch.maximum(pose, self.low), self.high) - self.center
        return self.level + (turned @ self.rows.T @ self.basis.flatten(0, 1).T).unflatten(1, (-1, 3))
