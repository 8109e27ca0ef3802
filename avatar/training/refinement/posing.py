"""The differentiable way from small turns of joints to posed vertices of a template, cheap on a CPU."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.register import BodyState, Kinematics
from smplxpp.skinning.linear_blend import forward_kinematics
from smplxpp.template.template import Template


class FirmSkinning(torch.autograd.Function):
    """(V, 3) rest, (J, 3, 4) transforms, (V, J) weights, (V,) firmness -> (V, 3) posed vertices, metres.

    Forward is linear blend skinning. Backward reaches rest positions and transforms, `dL/dG_j = sum_v w_vj f_v g_v
    [x_v; 1]^T`, with the pull g_v of every vertex scaled by its firmness f_v: what sits loosely is drawn where skinning
    puts it, and does not pull.
    """

    @staticmethod
    def forward(ctx: Any, rest: Tensor, transforms: Tensor, weights: Tensor, firmness: Tensor) -> Tensor:
        blended = (weights @ transforms.reshape(len(transforms), 12)).view(-1, 3, 4)
        ctx.save_for_backward(rest, blended, weights, firmness)
        x, y, z = rest.split(1, dim=-1)
        return blended[..., 0] * x + blended[..., 1] * y + blended[..., 2] * z + blended[..., 3]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None, None]:
        rest, blended, weights, firmness = ctx.saved_tensors
        pull = gradient * firmness[:, None]
        to_rest = torch.stack([(pull * blended[..., k]).sum(-1) for k in range(3)], dim=-1)
        outer = torch.cat([pull[:, :, None] * rest[:, None, :], pull[:, :, None]], dim=-1)
        to_transforms = (weights.T @ outer.view(len(rest), 12)).view(-1, 3, 4)
        return to_rest, to_transforms, None, None


@dataclass(frozen=True, eq=False)
class Steps:
    """Small changes of one frame, leaves of the graph at zero; float64.

    Attributes:
        turns: rotation vectors in the parents' posed frames, `R_j <- exp(d) R_j`, radians.
        transl: metres. expression: coefficients.
    """

    turns: Float[Tensor, "J 3"]
    transl: Float[Tensor, " 3"]
    expression: Float[Tensor, " E"]

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """All of them."""
        return self.turns, self.transl, self.expression


@dataclass(frozen=True, eq=False)
class Placed:
    """A template in the pose of one frame.

    Attributes:
        vertices: world, metres, with gradients to `steps`.
        steps: what may change.
        joints: posed, metres. turned: rotations of the joints in the world. parent_turned: those of their parents.
    """

    vertices: Float32[Tensor, "V 3"]
    steps: Steps
    joints: Float64[np.ndarray, "J 3"]
    turned: Float64[np.ndarray, "J 3 3"]
    parent_turned: Float64[np.ndarray, "J 3 3"]


class PosedTemplate:
    """Poses a template of one person, with gradients to small steps.

    Pose correctives are in the vertices, not in the derivatives: fractions of a millimetre a degree. The identity is
    the template's own.

    Args:
        firmness: of its vertices, see `firmness`.
    """

    def __init__(self, template: Template, firmness: Float64[np.ndarray, " V"]) -> None:
        self.template, self.body = template, template.body
        self.kinematics = Kinematics(template.body)
        self.weights = torch.tensor(template.weights.dense(), dtype=torch.float32)
        self.firmness = torch.tensor(firmness, dtype=torch.float32)
        self.faces = torch.tensor(template.faces)

    @cached_property
    def expression_dirs(self) -> Float32[Tensor, "B 3 E"]:
        """Metres a unit of expression, of the body's vertices."""
        return torch.tensor(self.body.exprdirs, dtype=torch.float32)

    @cached_property
    def expression_joints(self) -> Float64[Tensor, "J 3 E"]:
        """Metres a unit of expression, of the joints."""
        return torch.tensor(np.einsum("jv,vxe->jxe", self.body.joint_regressor, self.body.exprdirs))

    def place(self, state: BodyState, row: int) -> Placed:
        """Pose one frame of a state; its betas are not looked at."""
        body, count = self.body, self.body.vertex_count
        rotations = torch.tensor(state.rotations[row])
        turns = torch.zeros(len(rotations), 3, dtype=torch.float64, requires_grad=True)
        transl = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        expression = torch.zeros(body.num_expressions, dtype=torch.float64, requires_grad=True)
        shaped = body.v_template + body.exprdirs @ state.expression[row]
        rest_joints = body.joint_regressor @ shaped
        if body.posedirs is not None:
            shaped = shaped + body.posedirs @ (state.rotations[row, 1:] - np.eye(3)).ravel()
        rest = torch.tensor(self.template.vertices, dtype=torch.float32)
        rest[:count] = torch.tensor(shaped, dtype=torch.float32)
        moved = (self.expression_dirs @ expression.float()).view(count, 3)
        rest = rest + torch.nn.functional.pad(moved, (0, 0, 0, len(rest) - count))
        transforms, joints = forward_kinematics(
            torch.tensor(rest_joints) + self.expression_joints @ expression,
            self.kinematics.parents,
            matrix_from_rotvec(turns) @ rotations,
            transl=torch.tensor(state.transl[row]) + transl,
        )
        vertices = FirmSkinning.apply(rest, transforms[:, :3].float(), self.weights, self.firmness)
        turned = transforms[:, :3, :3].detach().numpy()
        parents = self.kinematics.parents
        above = np.where((parents < 0)[:, None, None], np.eye(3), turned[np.maximum(parents, 0)])
        return Placed(vertices, Steps(turns, transl, expression), joints.detach().numpy(), turned, above)

    def gradient(
        self, placed: Placed, of_vertices: Float[Tensor, "V 3"]
    ) -> tuple[Float64[np.ndarray, "J 3"], Float64[np.ndarray, " 3"], Float64[np.ndarray, " E"]]:
        """Return the gradients of turns, translation and expression from those of the posed vertices."""
        found = torch.autograd.grad(placed.vertices, placed.steps.tensors, of_vertices, allow_unused=True)
        filled = [torch.zeros_like(s) if g is None else g for s, g in zip(placed.steps.tensors, found, strict=True)]
        turns, transl, expression = (g.numpy() for g in filled)
        return turns, transl, expression
