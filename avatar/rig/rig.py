"""A template that torch can pose: what drives it in one frame, and its skinning with displaced vertices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from threadpoolctl import ThreadpoolController
from torch import Tensor
from torch.autograd.function import once_differentiable

from smplxpp.cloth.driver import ClothShape
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template

THETA = 63
"""Length of theta: 21 body joints, axis-angle."""


@dataclass(frozen=True, eq=False)
class ClothMotion:
    """Where simulated cloth is in one pose.

    Attributes:
        displacements: metres along the axes of the T-pose, to be added before skinning.
        share: in [0, 1]: how much of a vertex's displacement this is; a model's own is the rest.
    """

    displacements: Float32[Tensor, "V 3"]
    share: Float32[Tensor, "V 1"]


@dataclass(frozen=True, eq=False)
class Motion:
    """One pose of a template, ready for the networks and for skinning; float32.

    Attributes:
        frame: number of the training frame whose code the student takes; None for a new pose.
        pose: theta, radians. expression: coefficients. jaw: axis-angle, radians.
        rest: T-pose with this frame's expression and pose correctives, metres.
        world_from_rest: blended transforms of the vertices.
        root_from_world: takes the root's motion away.
        cloth: where the loose clothes are, if they are simulated.
        time: seconds since the motion began; None where nobody knows.
        known: in [0, 1]: how much the pose counts as one that training saw; None: models judge it.
    """

    frame: int | None
    pose: Float32[Tensor, " 63"]
    expression: Float32[Tensor, " E"]
    jaw: Float32[Tensor, " 3"]
    rest: Float32[Tensor, "V 3"]
    world_from_rest: Float32[Tensor, "V 3 4"]
    root_from_world: Float32[Tensor, "4 4"]
    cloth: ClothMotion | None = None
    time: float | None = None
    known: float | None = None

    def without_cloth(self) -> Motion:
        """Return the same pose, its clothes moved by nothing but the model."""
        return replace(self, cloth=None)

    def without_code(self) -> Motion:
        """Return the same pose without a frame's code, as models show new ones."""
        return replace(self, frame=None)

    def as_new(self) -> Motion:
        """Return the same pose as if training had not seen it."""
        return replace(self, frame=None, known=0.0)


class Rig:
    """Skinning of a template in torch, with displacements of its vertices in the T-pose.

    Args:
        template: the clothed body.
        device: of all tensors.
    """

    def __init__(self, template: Template, device: torch.device | str = "cpu") -> None:
        self.template, self.device = template, torch.device(device)
        self.faces = torch.tensor(template.faces, device=device)
        self.vertices = self._tensor(template.vertices)
        self.cloth_mask = torch.tensor(template.cloth_mask, device=device)
        self.body_mask = torch.tensor(template.vertex_part == 0, device=device)
        """(V,) of the body's own surface, bare or not."""
        self.semantic_colors = self._tensor(template.semantic_colors / 255.0)
        """(V, 3) in [0, 1]."""
        self._weights = template.weights.dense().astype(np.float32)

    @property
    def expression_size(self) -> int:
        """Number of the template's expression coefficients."""
        return self.template.body.num_expressions

    def motion(self, params: BodyParams, *, frame: int | None = None) -> Motion:
        """Return what one pose does to the template.

        Args:
            params: one frame. frame: its number, where the student has a code for it.

        Raises:
            InputError: several frames, or parameters that the body refuses.
        """
        if len(params) != 1:
            raise InputError("parameters of a pose", expected="one frame", received=f"{len(params)} frames")
        # A BLAS thread that has done its part spins on; torch's threads, which come next, would wait for its core.
        with _thread_pools().limit(limits=1, user_api="blas"):
            posed = self.template.posed_body(params)
            transforms = posed.posed_from_rest[0]
            blended = self._weights @ transforms[:, :3].reshape(len(transforms), 12).astype(np.float32)
        rest = self.template.vertices.astype(np.float32)
        rest[: self.template.body.vertex_count] = posed.rest_vertices[0]
        expression = np.zeros(self.expression_size)
        expression[: params.expression.shape[1]] = params.expression[0]
        return Motion(
            frame,
            pose=self._tensor(params.body_pose[0]),
            expression=self._tensor(expression),
            jaw=self._tensor(params.jaw_pose[0]),
            rest=self._tensor(rest),
            world_from_rest=self._tensor(blended.reshape(-1, 3, 4)),
            root_from_world=self._tensor(np.linalg.inv(transforms[0])),
        )

    def motion_to(self, vertices: Float[np.ndarray, "V 3"]) -> Motion:
        """Make the motion whose posed mesh is `vertices`, metres, to the bit: its T-pose, which skinning leaves alone.

        Raises:
            InputError: vertices of another number than the template's.
        """
        if vertices.shape != self.vertices.shape:
            raise InputError(
                "posed vertices", expected=f"shape {tuple(self.vertices.shape)}", received=str(vertices.shape)
            )
        return Motion(
            None,
            pose=torch.zeros(THETA, device=self.device),
            expression=torch.zeros(self.expression_size, device=self.device),
            jaw=torch.zeros(3, device=self.device),
            rest=self._tensor(vertices),
            world_from_rest=torch.eye(3, 4, device=self.device).expand(len(vertices), 3, 4),
            root_from_world=torch.eye(4, device=self.device),
        )

    def with_cloth(self, motion: Motion, shape: ClothShape, *, time: float | None = None) -> Motion:
        """Return a pose with the clothes where a simulation has them."""
        at = torch.as_tensor(shape.vertices, device=self.device)
        displacements = torch.zeros(len(self.vertices), 3, device=self.device)
        share = torch.zeros(len(self.vertices), 1, device=self.device)
        displacements[at] = self._tensor(shape.displacements)
        share[at, 0] = self._tensor(shape.share)
        return replace(motion, cloth=ClothMotion(displacements, share), time=time)

    def displaced(
        self, motion: Motion, displacements: Float[Tensor, "V 3"] | None = None
    ) -> Float[Tensor, "V 3"] | None:
        """Return a model's displacements, metres, with those of simulated clothes in their place; None for none."""
        if motion.cloth is None:
            return displacements
        simulated = motion.cloth.share * motion.cloth.displacements
        return simulated if displacements is None else simulated + (1.0 - motion.cloth.share) * displacements

    def pose(self, motion: Motion, displacements: Float[Tensor, "V 3"] | None = None) -> Float[Tensor, "V 3"]:
        """Return the vertices in the world, metres, `x = (sum_j w_j G_j) (v + dv)`.

        Args:
            displacements: dv, metres along the axes of the T-pose; gradients reach them. Where the motion has
                simulated clothes, theirs take over.
        """
        displacements = self.displaced(motion, displacements)
        rest = motion.rest if displacements is None else motion.rest + displacements
        return _Skinning.apply(rest, motion.world_from_rest)

    @torch.no_grad()
    def places(self, motion: Motion, displacements: Float[Tensor, "V 3"] | None = None) -> Float64[np.ndarray, "V 3"]:
        """Return what `pose` does, as numbers."""
        return self.pose(motion, displacements).double().cpu().numpy()

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.tensor(array, dtype=torch.float32, device=self.device)


@cache
def _thread_pools() -> ThreadpoolController:
    """Looks through all loaded libraries: once, not for every pose."""
    return ThreadpoolController()


class _Skinning(torch.autograd.Function):
    """(V, 3) rest positions, (V, 3, 4) transforms -> (V, 3); gradients reach the positions.

    Written as sums of columns: a batched product of (3, 3) matrices, or a sum over an axis of three, is several times
    slower on a CPU.
    """

    @staticmethod
    def forward(ctx, rest: Tensor, world_from_rest: Tensor) -> Tensor:
        ctx.save_for_backward(world_from_rest)
        return world_from_rest[..., 3] + _column_sum(rest, world_from_rest.unbind(-1))

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        (world_from_rest,) = ctx.saved_tensors
        return _column_sum(gradient, world_from_rest[..., :3].unbind(-2)), None


def _column_sum(factors: Tensor, columns: Sequence[Tensor]) -> Tensor:
    """`sum_k factors_k columns_k` of (V, 3) factors and the first three (V, 3) columns."""
    x, y, z = factors.split(1, dim=-1)
    return torch.addcmul(torch.addcmul(columns[0] * x, columns[1], y), columns[2], z)
