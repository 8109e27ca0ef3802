"""Which numbers of a frame are refined: their order in a vector, their steps, how points move with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians, corner_weights
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.evidence import Evidence
from avatar.training.refinement.posing import Placed, PosedTemplate
from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.register import BodyState

NOTHING = 1e-3
"""Share of the mean curvature below which a Gaussian says nothing."""
SAMPLED = 6000
"""Gaussians that a curvature is summed over, at least, where there are more: it is a mean of neighbours anyway."""
BODY_JOINTS, JAW, FIRST_FINGER = 22, 22, 25
"""Joints of the SMPL-X order: root and body first, then the jaw, the eyes, the fingers."""


@dataclass(frozen=True, eq=False)
class Variables:
    """The P numbers of a frame that are refined: turns of joints, translation, expression.

    Attributes:
        joints: that turn.
        expressions: number of coefficients.
        sigma: what each number of the start is trusted to.
    """

    joints: Int64[np.ndarray, " K"]
    expressions: int
    sigma: Float64[np.ndarray, " P"]

    def __len__(self) -> int:
        return len(self.sigma)

    @staticmethod
    def of_body(joint_count: int, expressions: int, config: RefineConfig) -> Variables:
        """Choose those that a body has and the configuration asks for."""
        joints = list(range(min(BODY_JOINTS, joint_count)))
        if config.jaw and joint_count > FIRST_FINGER:
            joints.append(JAW)
        if config.hands:
            joints += range(FIRST_FINGER, joint_count)
        expressions = expressions if config.expression else 0
        sigma = np.concatenate(
            [
                np.full(3 * len(joints), np.radians(config.rotation_sigma)),
                np.full(3, config.translation_sigma),
                np.full(expressions, config.expression_sigma),
            ]
        )
        return Variables(np.array(joints), expressions, sigma)

    @property
    def turns(self) -> slice:
        """Where the turns are."""
        return slice(0, 3 * len(self.joints))

    @property
    def transl(self) -> slice:
        """Where the translation is."""
        return slice(3 * len(self.joints), 3 * len(self.joints) + 3)

    @property
    def expression(self) -> slice:
        """Where the expression is."""
        return slice(3 * len(self.joints) + 3, len(self))

    def packed(self, turns: np.ndarray, transl: np.ndarray, expression: np.ndarray) -> Float64[np.ndarray, "*T P"]:
        """One vector of (..., J, 3) turns, (..., 3) translations and (..., E) coefficients."""
        chosen = turns[..., self.joints, :]
        flat = chosen.reshape(*chosen.shape[:-2], -1)
        return np.concatenate([flat, transl, expression[..., : self.expressions]], axis=-1)

    def stepped(self, state: BodyState, steps: Float64[np.ndarray, "T P"]) -> BodyState:
        """The state after steps, `R_j <- exp(d_j) R_j`."""
        rotations = state.rotations.copy()
        turned = matrix_from_rotvec(steps[:, self.turns].reshape(len(steps), -1, 3))
        rotations[:, self.joints] = turned @ rotations[:, self.joints]
        expression = state.expression.copy()
        expression[:, : self.expressions] += steps[:, self.expression]
        return BodyState(rotations, state.transl + steps[:, self.transl], state.betas, expression)


class GaussianMotion:
    """How the centres of Gaussians move with the variables of a frame, for the curvature of the loss.

    Args:
        posed: the template. gaussians: on it. variables: of a frame.
    """

    def __init__(self, posed: PosedTemplate, gaussians: BoundGaussians, variables: Variables) -> None:
        self.posed, self.variables = posed, variables
        corners = posed.faces[gaussians.face_index]
        weight = corner_weights(gaussians.barycentric)
        skin = (weight[..., None] * posed.weights[corners]).sum(1)
        hangs = torch.tensor(posed.kinematics.descends_from[:, variables.joints], dtype=torch.float32)
        self.hanging = skin @ hangs
        """(N, K): share of a Gaussian that follows each joint."""
        self.firmness = (weight * posed.firmness[corners]).sum(1)
        head = torch.zeros(len(posed.firmness), 3, variables.expressions)
        head[: posed.body.vertex_count] = posed.expression_dirs[..., : variables.expressions]
        moves = head.abs().amax(dim=(1, 2))[corners].amax(1) > 0 if variables.expressions else torch.zeros(0)
        self.facial = torch.nonzero(moves).flatten()
        self.facial_dirs = (weight[self.facial, :, None, None] * head[corners[self.facial]]).sum(1)
        self.facial_skin = skin[self.facial]

    def curvature(self, placed: Placed, evidence: Evidence) -> Float64[np.ndarray, "P P"]:
        """Return `sum_i f_i J_i^T M_i J_i` over the Gaussians that say something, f their firmness."""
        strength = evidence.curvature.diagonal(dim1=1, dim2=2).sum(-1) * self.firmness
        rows = torch.nonzero(strength > NOTHING * strength.mean()).flatten()
        every = max(1, len(rows) // SAMPLED)
        rows = rows[::every].contiguous()
        J = self.jacobian(placed, evidence.means, rows)
        M = evidence.curvature[rows] * (every * self.firmness[rows, None, None])
        moved = M @ J
        P, at = len(self.variables), self.variables.expression.start
        out = np.zeros((P, P))
        out[:at, :at] = _product(J, moved)
        if P > at:
            facial = torch.isin(self.facial, rows)
            own = self.facial_jacobian(placed, facial)
            place = torch.searchsorted(rows, self.facial[facial])
            out[:at, at:] = _product(moved[place], own)
            out[at:, :at] = out[:at, at:].T
            out[at:, at:] = _product(own, M[place] @ own)
        return 0.5 * (out + out.T)

    def jacobian(
        self, placed: Placed, means: Float32[Tensor, "N 3"], rows: Int64[Tensor, " n"]
    ) -> Float32[Tensor, "n 3 Q"]:
        """Return how centres move with turns and translation, metres a unit.

        A turn d about joint j moves a point by `s_j (P_j d) x (x - p_j)`, s_j the share of it that hangs on the joint:
        exact where a point has one weight, good enough where it has several, for a curvature.
        """
        variables = self.variables
        joints = torch.tensor(placed.joints[variables.joints], dtype=torch.float32)
        axes = torch.tensor(placed.parent_turned[variables.joints], dtype=torch.float32)
        arm = (means[rows, None, :] - joints) * self.hanging[rows, :, None]  # (n, K, 3)
        out = means.new_zeros(len(rows), 3, variables.transl.stop)
        turns = out[:, :, variables.turns].unflatten(2, (-1, 3))  # (n, 3, K, axis)
        for k, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):  # row k of the cross product
            turns[:, k] = axes[:, a] * arm[..., b, None] - axes[:, b] * arm[..., a, None]
        out[:, :, variables.transl] = torch.eye(3)
        return out

    def facial_jacobian(self, placed: Placed, chosen: Bool[Tensor, " M"]) -> Float32[Tensor, "n 3 E"]:
        """Return how chosen centres of `facial` move with the expression, metres a unit."""
        turned = torch.tensor(placed.turned, dtype=torch.float32).reshape(-1, 9)
        return (self.facial_skin[chosen] @ turned).view(-1, 3, 3) @ self.facial_dirs[chosen]


def _product(left: Tensor, right: Tensor) -> np.ndarray:
    """`sum_i L_i^T R_i` of (n, 3, a) and (n, 3, b)."""
    return (left.reshape(-1, left.shape[-1]).T @ right.reshape(-1, right.shape[-1])).double().numpy()
