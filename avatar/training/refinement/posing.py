"""Posing of a template with gradients to small steps of its pose, and the rigidity with which vertices act on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import igl
import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from smplxpp.core import matrix_from_rotvec
from smplxpp.register import BodyState, Kinematics
from smplxpp.skinning.linear_blend import forward_kinematics
from smplxpp.template.template import Template

CLOTH_RIGIDITY: Mapping[str, float] = {"upper": 1.0, "lower": 0.5, "outer": 0.5}
"""Rigidity of clothes that touch the skin, by label; smaller values let clothes act less on the pose."""


def rigidity(
    template: Template, reach: float, *, factors: Mapping[str, float] = CLOTH_RIGIDITY
) -> Float64[np.ndarray, " V"]:
    """Return how rigidly each vertex follows the body, in [0, 1]: the weight of its residual on the pose.

    1 on body, hair and shoes. On clothes `c exp(-(d / reach)^2)`, d the distance from the naked body in the T-pose and
    c the label's factor; 0 below 0.02. A waistband determines where the body is, a hem does not.

    Args:
        template: the clothed body.
        reach: metres.
        factors: c by the label's name; 0 for others.
    """
    least = 0.02  # cloth of less rigidity hangs loosely and would only add noise
    rigid = np.ones(template.vertex_count)
    # Clothes: a Gaussian of the distance from the body, times the label's factor.
    cloth = np.flatnonzero(template.cloth_mask)
    if len(cloth):
        body = template.part_mesh("body")
        squared = igl.point_mesh_squared_distance(template.vertices[cloth], body.vertices, body.faces)[0]
        # A label of the user's own has the factor of the class that it behaves like; what lies on the skin follows it.
        of_label = {one.id: 1.0 if one.tight else factors.get(one.kind, 0.0) for one in template.labels.cloth}
        factor = np.array([of_label[int(label)] for label in template.vertex_labels[cloth]])
        rigid[cloth] = factor * np.exp(-squared / reach**2)
    rigid[rigid < least] = 0.0
    return rigid


class RigiditySkinning(torch.autograd.Function):
    """(V, 3) rest, (J, 3, 4) transforms, (V, J) weights, (V,) rigidity -> (V, 3) posed vertices, metres.

    Forward is linear blend skinning. Backward reaches rest positions and transforms, `dL/dG_j = sum_v w_vj f_v g_v
    [x_v; 1]^T`, with the gradient g_v of every vertex scaled by its rigidity f_v: loose cloth is drawn where skinning
    places it but does not act on the pose.
    """

    @staticmethod
    def forward(ctx: Any, rest: Tensor, transforms: Tensor, weights: Tensor, rigidity: Tensor) -> Tensor:
        # The weighted sum of the joints' 3 x 4 transforms at each vertex, applied to [x, y, z, 1].
        blended = (weights @ transforms.reshape(len(transforms), 12)).view(-1, 3, 4)
        ctx.save_for_backward(rest, blended, weights, rigidity)
        x, y, z = rest.split(1, dim=-1)
        return blended[..., 0] * x + blended[..., 1] * y + blended[..., 2] * z + blended[..., 3]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None, None]:
        rest, blended, weights, rigidity = ctx.saved_tensors
        # The gradient of every vertex, weighted by its rigidity.
        weighted = gradient * rigidity[:, None]
        to_rest = torch.stack([(weighted * blended[..., k]).sum(-1) for k in range(3)], dim=-1)
        # Sum of w f g [x; 1]^T over the vertices of each joint.
        outer = torch.cat([weighted[:, :, None] * rest[:, None, :], weighted[:, :, None]], dim=-1)
        to_transforms = (weights.T @ outer.view(len(rest), 12)).view(-1, 3, 4)
        return to_rest, to_transforms, None, None


@dataclass(frozen=True, eq=False)
class Steps:
    """Small steps of one frame's pose, leaves of the graph at zero; float64.

    Attributes:
        turns: rotation vectors in the parents' posed frames, `R_j <- exp(d_j) R_j`, radians.
        transl: step of the translation, metres.
        expression: steps of the coefficients.
    """

    turns: Float[Tensor, "J 3"]
    transl: Float[Tensor, " 3"]
    expression: Float[Tensor, " E"]

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """The three leaves of the graph, in the order of the attributes."""
        return self.turns, self.transl, self.expression


@dataclass(frozen=True, eq=False)
class Placed:
    """A template in the pose of one frame.

    Attributes:
        vertices: world, metres, with gradients to `steps`.
        steps: small changes of the pose, at zero.
        joints: posed joints, world, metres.
        turned: rotations of the joints in the world.
        parent_turned: rotations of their parents in the world.
    """

    vertices: Float32[Tensor, "V 3"]
    steps: Steps
    joints: Float64[np.ndarray, "J 3"]
    turned: Float64[np.ndarray, "J 3 3"]
    parent_turned: Float64[np.ndarray, "J 3 3"]


class PosedTemplate:
    """Poses a template of one person, with gradients to small steps.

    Pose correctives are in the vertices but not in the derivatives, where they are fractions of a millimetre a degree.
    The shape is the template's own.

    Args:
        template: the clothed body.
        rigidity: of its vertices, see the function `rigidity`.
    """

    def __init__(self, template: Template, rigidity: Float64[np.ndarray, " V"]) -> None:
        self.template, self.body = template, template.body
        self.kinematics = Kinematics(template.body)
        self.weights = torch.tensor(template.weights.dense(), dtype=torch.float32)
        self.rigidity = torch.tensor(rigidity, dtype=torch.float32)
        self.faces = torch.tensor(template.faces)

    @cached_property
    def expression_dirs(self) -> Float32[Tensor, "B 3 E"]:
        """Derivative of the body's vertices by the expression coefficients, metres a unit."""
        return torch.tensor(self.body.exprdirs, dtype=torch.float32)

    @cached_property
    def expression_joints(self) -> Float64[Tensor, "J 3 E"]:
        """Derivative of the joints by the expression coefficients, metres a unit."""
        return torch.tensor(np.einsum("jv,vxe->jxe", self.body.joint_regressor, self.body.exprdirs))

    def place(self, state: BodyState, row: int) -> Placed:
        """Pose one frame of a state; its betas are ignored."""
        body, count = self.body, self.body.vertex_count
        # Steps at zero: the leaves of the graph.
        rotations = torch.tensor(state.rotations[row])
        turns = torch.zeros(len(rotations), 3, dtype=torch.float64, requires_grad=True)
        transl = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        expression = torch.zeros(body.num_expressions, dtype=torch.float64, requires_grad=True)
        # Rest shape with expression and pose correctives, in numpy, without gradients.
        shaped = body.v_template + body.exprdirs @ state.expression[row]
        rest_joints = body.joint_regressor @ shaped
        if body.posedirs is not None:
            shaped = shaped + body.posedirs @ (state.rotations[row, 1:] - np.eye(3)).ravel()
        rest = torch.tensor(self.template.vertices, dtype=torch.float32)
        rest[:count] = torch.tensor(shaped, dtype=torch.float32)
        # Derivatives of the expression, added at zero steps.
        moved = (self.expression_dirs @ expression.float()).view(count, 3)
        rest = rest + torch.nn.functional.pad(moved, (0, 0, 0, len(rest) - count))
        # Forward kinematics and skinning; gradients of loose vertices are scaled down.
        transforms, joints = forward_kinematics(
            torch.tensor(rest_joints) + self.expression_joints @ expression,
            self.kinematics.parents,
            matrix_from_rotvec(turns) @ rotations,
            transl=torch.tensor(state.transl[row]) + transl,
        )
        vertices = RigiditySkinning.apply(rest, transforms[:, :3].float(), self.weights, self.rigidity)
        # World rotations of joints and parents, for the Jacobian.
        turned = transforms[:, :3, :3].detach().numpy()
        parents = self.kinematics.parents
        above = np.where((parents < 0)[:, None, None], np.eye(3), turned[np.maximum(parents, 0)])
        return Placed(vertices, Steps(turns, transl, expression), joints.detach().numpy(), turned, above)

    def gradient(
        self, placed: Placed, of_vertices: Float[Tensor, "V 3"]
    ) -> tuple[Float64[np.ndarray, "J 3"], Float64[np.ndarray, " 3"], Float64[np.ndarray, " E"]]:
        """Backpropagate gradients of the posed vertices to turns, translation and expression."""
        # Steps without influence have no gradient: fill in zeros.
        found = torch.autograd.grad(placed.vertices, placed.steps.tensors, of_vertices, allow_unused=True)
        filled = [torch.zeros_like(s) if g is None else g for s, g in zip(placed.steps.tensors, found, strict=True)]
        turns, transl, expression = (g.numpy() for g in filled)
        return turns, transl, expression
