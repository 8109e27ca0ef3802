"""The unknowns of a frame: their order in a vector, their steps, and the Jacobian of Gaussian centres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from avatar.gaussians.binding import BoundGaussians, corner_weights
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.photometric import Linearization
from avatar.training.refinement.posing import Placed, PosedTemplate
from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.register import BodyState

# Joints of the SMPL-X order: the root and 21 body joints first, then the jaw, two eyes, and the fingers.
BODY_JOINTS, JAW, FIRST_FINGER = 22, 22, 25


@dataclass(frozen=True, eq=False)
class Variables:
    """The P unknowns of a frame, in this order: turns of K joints (3 each), translation (3), expression.

    Attributes:
        joints: indices of the joints that turn.
        expressions: number of expression coefficients.
        sigma: standard deviation of the prior about the start: radians, metres, coefficients.
    """

    joints: Int64[np.ndarray, " K"]
    expressions: int
    sigma: Float64[np.ndarray, " P"]

    def __len__(self) -> int:
        return len(self.sigma)

    @staticmethod
    def of_body(joint_count: int, expressions: int, config: RefineConfig) -> Variables:
        """Choose the unknowns that a body has and the configuration requests."""
        # Joints that turn.
        joints = list(range(min(BODY_JOINTS, joint_count)))
        if config.jaw and joint_count > FIRST_FINGER:
            joints.append(JAW)
        if config.hands:
            joints += range(FIRST_FINGER, joint_count)
        # Standard deviations of the prior, in the order of the unknowns.
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
        """Columns of the turns in the vector of unknowns."""
        return slice(0, 3 * len(self.joints))

    @property
    def transl(self) -> slice:
        """Columns of the translation in the vector of unknowns."""
        return slice(3 * len(self.joints), 3 * len(self.joints) + 3)

    @property
    def expression(self) -> slice:
        """Columns of the expression in the vector of unknowns."""
        return slice(3 * len(self.joints) + 3, len(self))

    def packed(self, turns: np.ndarray, transl: np.ndarray, expression: np.ndarray) -> Float64[np.ndarray, "*T P"]:
        """Pack (..., J, 3) turns, (..., 3) translations and (..., E) coefficients into vectors of unknowns."""
        # Only the joints and coefficients that are unknowns; all others stay at their start.
        chosen = turns[..., self.joints, :]
        flat = chosen.reshape(*chosen.shape[:-2], -1)
        return np.concatenate([flat, transl, expression[..., : self.expressions]], axis=-1)

    def stepped(self, state: BodyState, steps: Float64[np.ndarray, "T P"]) -> BodyState:
        """Return the state after steps: `R_j <- exp(d_j) R_j`, translation and expression added."""
        # Left-multiply the rotations by the exponentials of the turns; translation and expression are added.
        rotations = state.rotations.copy()
        turned = matrix_from_rotvec(steps[:, self.turns].reshape(len(steps), -1, 3))
        rotations[:, self.joints] = turned @ rotations[:, self.joints]
        expression = state.expression.copy()
        expression[:, : self.expressions] += steps[:, self.expression]
        return BodyState(rotations, state.transl + steps[:, self.transl], state.betas, expression)


class CentreJacobian:
    """Derivatives of Gaussian centres by the unknowns of a frame, for the Gauss-Newton matrix.

    Args:
        posed: the template.
        gaussians: bound to the template.
        variables: the unknowns of a frame.

    Attributes:
        descends: (N, K) share of a Gaussian's skin weights on each joint and its descendants.
        rigidity: (N,) of the Gaussians.
        facial: indices of the M Gaussians that the expression moves.
        facial_dirs: (M, 3, E) their derivatives by the expression in the T-pose, metres a unit.
        facial_skin: (M, J) their skin weights.
    """

    def __init__(self, posed: PosedTemplate, gaussians: BoundGaussians, variables: Variables) -> None:
        self.posed, self.variables = posed, variables
        # Interpolate the weights of the triangle's corners at each Gaussian.
        corners = posed.faces[gaussians.face_index]
        weight = corner_weights(gaussians.barycentric)
        skin = (weight[..., None] * posed.weights[corners]).sum(1)
        # (J, K) whether joint i moves when joint k turns; its product with skin weights (N, J) is `descends`.
        hangs = torch.tensor(posed.kinematics.descends_from[:, variables.joints], dtype=torch.float32)
        self.descends = skin @ hangs
        self.rigidity = (weight * posed.rigidity[corners]).sum(1)
        # Gaussians of the face that the expression moves.
        head = torch.zeros(len(posed.rigidity), 3, variables.expressions)
        head[: posed.body.vertex_count] = posed.expression_dirs[..., : variables.expressions]
        moves = head.abs().amax(dim=(1, 2))[corners].amax(1) > 0 if variables.expressions else torch.zeros(0)
        self.facial = torch.nonzero(moves).flatten()
        self.facial_dirs = (weight[self.facial, :, None, None] * head[corners[self.facial]]).sum(1)
        self.facial_skin = skin[self.facial]

    def curvature(self, placed: Placed, linear: Linearization) -> Float64[np.ndarray, "P P"]:
        """Return the Gauss-Newton matrix of a frame, `sum_i f_i J_i^T M_i J_i` over the Gaussians, f their rigidity.

        Gaussians of little curvature are left out, and of the others every n-th stands for n of them, because
        neighbours have nearly the same J.

        Args:
            placed: the template in the frame's pose.
            linear: linearisation of the loss about that pose.
        """
        # Gaussians below this share of the mean curvature are left out; at least this number of the others is summed.
        least_share, sampled = 1e-3, 6000
        strength = linear.curvature.diagonal(dim1=1, dim2=2).sum(-1) * self.rigidity
        rows = torch.nonzero(strength > least_share * strength.mean()).flatten()
        every = max(1, len(rows) // sampled)
        rows = rows[::every].contiguous()
        # Block of turns and translation.
        J = self.jacobian(placed, linear.means, rows)
        M = linear.curvature[rows] * (every * self.rigidity[rows, None, None])
        moved = M @ J
        P, at = len(self.variables), self.variables.expression.start
        out = np.zeros((P, P))
        out[:at, :at] = _product(J, moved)
        # Blocks of the expression, over the Gaussians that it moves.
        if P > at:
            facial = torch.isin(self.facial, rows)
            # Rows of M that belong to these Gaussians: both index lists are ascending, so a binary search finds them.
            own = self.facial_jacobian(placed, facial)
            place = torch.searchsorted(rows, self.facial[facial])
            out[:at, at:] = _product(moved[place], own)
            out[at:, :at] = out[:at, at:].T
            out[at:, at:] = _product(own, M[place] @ own)
        # Exactly symmetric, as the banded Cholesky solver expects; rounding leaves small differences.
        return 0.5 * (out + out.T)

    def jacobian(
        self, placed: Placed, means: Float32[Tensor, "N 3"], rows: Int64[Tensor, " n"]
    ) -> Float32[Tensor, "n 3 Q"]:
        """Return the derivatives of chosen centres by turns and translation, metres a unit.

        A turn d of joint j moves a point by `s_j (P_j d) x (x - p_j)`, P_j the parent's rotation, p_j the joint and s_j
        the point's skin weight on the joint and its descendants. This is exact for points with one weight and accurate
        enough for a curvature otherwise.

        Args:
            placed: the template in the frame's pose.
            means: centres of all Gaussians, world, metres.
            rows: the n chosen ones.
        """
        # Joints p_j, parents' axes P_j and arms s_j (x - p_j), for the cross product.
        variables = self.variables
        joints = torch.tensor(placed.joints[variables.joints], dtype=torch.float32)
        axes = torch.tensor(placed.parent_turned[variables.joints], dtype=torch.float32)
        arm = (means[rows, None, :] - joints) * self.descends[rows, :, None]  # (n, K, 3)
        out = means.new_zeros(len(rows), 3, variables.transl.stop)
        turns = out[:, :, variables.turns].unflatten(2, (-1, 3))  # (n, 3, K, axis)
        for k, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):  # row k of the cross product
            turns[:, k] = axes[:, a] * arm[..., b, None] - axes[:, b] * arm[..., a, None]
        out[:, :, variables.transl] = torch.eye(3)
        return out

    def facial_jacobian(self, placed: Placed, chosen: Bool[Tensor, " M"]) -> Float32[Tensor, "n 3 E"]:
        """Return the derivatives of chosen centres of `facial` by the expression, metres a unit."""
        # Skinning's rotation of each Gaussian, the weighted sum of its joints' rotations, turns the derivative of the
        # T-pose.
        turned = torch.tensor(placed.turned, dtype=torch.float32).reshape(-1, 9)
        return (self.facial_skin[chosen] @ turned).view(-1, 3, 3) @ self.facial_dirs[chosen]


def _product(left: Tensor, right: Tensor) -> np.ndarray:
    """Return `sum_i L_i^T R_i` of (n, 3, a) and (n, 3, b), as one matrix product."""
    return (left.reshape(-1, left.shape[-1]).T @ right.reshape(-1, right.shape[-1])).double().numpy()
