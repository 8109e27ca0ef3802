"""The rig: a template that torch skins, `Pose` (the inputs of one frame), simulated cloth, and the posed avatar."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from threading import Lock
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64
from threadpoolctl import ThreadpoolController
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from avatar.gaussians.binding import BoundGaussians, WorldGaussians
from smplxpp.cloth.driver import ClothShape
from smplxpp.core import BodyParams, InputError
from smplxpp.core.errors import one_line
from smplxpp.template.template import Template

THETA = 63
"""Length of the body pose theta: 21 joints of SMPL-X, an axis-angle each."""


@dataclass(frozen=True, eq=False)
class SimulatedCloth:
    """Displacements of simulated cloth in one pose.

    Attributes:
        displacements: metres along the axes of the T-pose, to be added before skinning.
        share: in [0, 1], weight of the simulated displacement; the model's own has the rest.
    """

    displacements: Float32[Tensor, "V 3"]
    share: Float32[Tensor, "V 1"]

    __repr__ = one_line


@dataclass(frozen=True, eq=False)
class Pose:
    """One posed frame of a template, ready for the networks and for skinning; float32.

    Attributes:
        frame: number of the training frame whose code the student takes; None for a new pose.
        body_pose: theta, axis-angles of 21 joints, radians.
        expression: coefficients of the expression.
        jaw: axis-angle, radians.
        rest: T-pose with this frame's expression and pose correctives, metres.
        world_from_rest: blended transforms of the vertices.
        root_from_world: inverse of the root's transform.
        cloth: simulated displacements of the loose clothes; None where they are not simulated.
        time: seconds since the motion began; None where that is unknown.
        known: in [0, 1], weight of the pose as one of the training's; None: the model's pose gate decides.
    """

    frame: int | None
    body_pose: Float32[Tensor, " 63"]
    expression: Float32[Tensor, " E"]
    jaw: Float32[Tensor, " 3"]
    rest: Float32[Tensor, "V 3"]
    world_from_rest: Float32[Tensor, "V 3 4"]
    root_from_world: Float32[Tensor, "4 4"]
    cloth: SimulatedCloth | None = None
    time: float | None = None
    known: float | None = None

    __repr__ = one_line

    def to(self, device: torch.device | str) -> Pose:
        """Return the same pose on another device; a GPU is not waited for where its memory is pinned."""
        return self._with(lambda tensor: tensor.to(device, non_blocking=True))

    def pinned(self) -> Pose:
        """Return the same pose in memory that a GPU reads by itself."""
        return self._with(Tensor.pin_memory)

    def _with(self, change: Callable[[Tensor], Tensor]) -> Pose:
        assert self.cloth is None, "a pose without simulated clothes"
        changed: dict[str, Any] = {name: change(value) for name, value in vars(self).items() if torch.is_tensor(value)}
        return replace(self, **changed)

    def without_cloth(self) -> Pose:
        """Return the same pose without simulated clothes, so that the model alone moves them."""
        return replace(self, cloth=None)

    def without_code(self) -> Pose:
        """Return the same pose without a frame number, so that models use no frame code."""
        return replace(self, frame=None)

    def as_new(self) -> Pose:
        """Return the same pose marked as unseen by training: no frame code, `known` 0."""
        return replace(self, frame=None, known=0.0)


class Rig:
    """Skinning of a template in torch, with displacements of its vertices in the T-pose.

    Args:
        template: the clothed body.
        device: of all tensors.
    """

    def __init__(self, template: Template, device: torch.device | str = "cpu") -> None:
        # Constants of the template as tensors; the dense (V, J) weights stay in numpy, where poses are blended.
        self.template, self.device = template, torch.device(device)
        self.faces = torch.tensor(template.faces, device=device)
        self.vertices = self._tensor(template.vertices)
        self.cloth_mask = torch.tensor(template.cloth_mask, device=device)
        self.body_mask = torch.tensor(template.vertex_part == 0, device=device)
        """(V,) of the body's own surface, bare or not."""
        self.semantic_colors = self._tensor(template.semantic_colors / 255.0)
        """(V, 3) in [0, 1]."""
        self._weights = template.weights.dense().astype(np.float32)
        self._device_weights: Tensor | None = None
        self._last = torch.tensor([3], device=device)

    @property
    def expression_size(self) -> int:
        """Number of the template's expression coefficients."""
        return self.template.body.num_expressions

    def pose(self, params: BodyParams, *, frame: int | None = None, device: torch.device | str | None = None) -> Pose:
        """Return one frame's parameters as a pose of the template: rest shape and blended transforms.

        Args:
            params: parameters of one frame.
            frame: its number, where the student has a code for it.
            device: of the pose; None: the rig's.

        Raises:
            InputError: several frames, or parameters that the body refuses.
        """
        if len(params) != 1:
            raise InputError("parameters of a pose", expected="one frame", received=f"{len(params)} frames")
        # One BLAS thread: idle BLAS threads spin and would take the cores from torch's threads, which run next.
        # One pose at a time, because the limit is of the process.
        with _POSING, _thread_pools().limit(limits=1, user_api="blas"):
            posed = self.template.posed_body(params)
            transforms = posed.posed_from_rest[0]
            blended = self._weights @ transforms[:, :3].reshape(len(transforms), 12).astype(np.float32)
        # Rest shape: the template with the body's expression and pose correctives.
        rest = self.template.vertices.astype(np.float32)
        rest[: self.template.body.vertex_count] = posed.rest_vertices[0]
        expression = np.zeros(self.expression_size)
        expression[: params.expression.shape[1]] = params.expression[0]
        arrays: dict[str, np.ndarray] = {
            "body_pose": params.body_pose[0],
            "expression": expression,
            "jaw": params.jaw_pose[0],
            "rest": rest,
            "world_from_rest": blended.reshape(-1, 3, 4),
            "root_from_world": np.linalg.inv(transforms[0]),
        }
        tensors: dict[str, Any] = {name: self._tensor(array, device) for name, array in arrays.items()}
        return Pose(frame, **tensors)

    def pose_on_device(self, params: Mapping[str, Float[Tensor, "1 _"]], *, flat_hand_mean: bool = False) -> Pose:
        """Return the pose of parameters that lie on the rig's device, computed there without waiting for it.

        It equals `pose` within the rounding of float32, and gradients reach the parameters.

        Args:
            params: tensors of one frame by the names of `BodyParams`, without the shape.
            flat_hand_mean: see `BodyParams`.
        """
        if self._device_weights is None:
            self._device_weights = self._tensor(self._weights)
        posed = self.template.body.forward(params, flat_hand_mean=flat_hand_mean)
        transforms, joints = posed.posed_from_rest[0], len(posed.posed_from_rest[0])
        blended = self._device_weights @ transforms[:, :3].reshape(joints, 12)
        # The inverse of a rigid transform, (R, t) -> (R^T, -R^T t).
        turn = transforms[0, :3, :3].T
        upper = torch.cat([turn, -turn @ transforms[0, :3, 3:]], dim=1)
        body = posed.rest_vertices[0]
        return Pose(
            None,
            body_pose=params["body_pose"][0],
            expression=params["expression"][0],
            jaw=params["jaw_pose"][0],
            rest=torch.cat([body, self.vertices[len(body) :]]),
            world_from_rest=blended.unflatten(1, (3, 4)),
            root_from_world=torch.cat([upper, torch.zeros_like(upper[:1]).index_fill(1, self._last, 1.0)]),
        )

    def pose_from_vertices(self, vertices: Float[np.ndarray, "V 3"]) -> Pose:
        """Return the pose whose skinned mesh equals `vertices`, metres, to the bit.

        The vertices are its rest shape, and all its transforms are the identity.

        Raises:
            InputError: vertices of another number than the template's.
        """
        if vertices.shape != self.vertices.shape:
            raise InputError(
                "posed vertices", expected=f"shape {tuple(self.vertices.shape)}", received=str(vertices.shape)
            )
        # Identity transforms make skinning an exact copy: x = I v + 0.
        return Pose(
            None,
            body_pose=torch.zeros(THETA, device=self.device),
            expression=torch.zeros(self.expression_size, device=self.device),
            jaw=torch.zeros(3, device=self.device),
            rest=self._tensor(vertices),
            world_from_rest=torch.eye(3, 4, device=self.device).expand(len(vertices), 3, 4),
            root_from_world=torch.eye(4, device=self.device),
        )

    def with_cloth(self, pose: Pose, shape: ClothShape, *, time: float | None = None) -> Pose:
        """Return the pose with a simulation's cloth displacements, scattered to all vertices."""
        # Scatter displacements and shares to all vertices.
        at = torch.as_tensor(shape.vertices, device=self.device)
        displacements = torch.zeros(len(self.vertices), 3, device=self.device)
        share = torch.zeros(len(self.vertices), 1, device=self.device)
        displacements[at] = self._tensor(shape.displacements)
        share[at, 0] = self._tensor(shape.share)
        return replace(pose, cloth=SimulatedCloth(displacements, share), time=time)

    def displaced(self, pose: Pose, displacements: Float[Tensor, "V 3"] | None = None) -> Float[Tensor, "V 3"] | None:
        """Return a model's displacements, metres, blended with the simulated ones by their share; None for none."""
        if pose.cloth is None:
            return displacements
        # Linear blend: dv = s dv_simulated + (1 - s) dv_model, with the share s of each vertex in [0, 1].
        simulated = pose.cloth.share * pose.cloth.displacements
        return simulated if displacements is None else simulated + (1.0 - pose.cloth.share) * displacements

    def skin(self, pose: Pose, displacements: Float[Tensor, "V 3"] | None = None) -> Float[Tensor, "V 3"]:
        """Return the vertices in the world, metres, `x = (sum_j w_j G_j) (v + dv)`.

        Args:
            displacements: dv, metres along the axes of the T-pose; gradients reach them. Where the pose has
                simulated clothes, theirs replace them.
        """
        displacements = self.displaced(pose, displacements)
        rest = pose.rest if displacements is None else pose.rest + displacements
        return _Skinning.apply(rest, pose.world_from_rest)

    @torch.no_grad()
    def skin_to_numpy(
        self, pose: Pose, displacements: Float[Tensor, "V 3"] | None = None
    ) -> Float64[np.ndarray, "V 3"]:
        """Return the vertices of `skin` as a numpy array, without gradients."""
        return self.skin(pose, displacements).double().cpu().numpy()

    def _tensor(self, array: np.ndarray, device: torch.device | str | None = None) -> Tensor:
        return torch.tensor(array, dtype=torch.float32, device=self.device if device is None else device)


_POSING = Lock()


@cache
def _thread_pools() -> ThreadpoolController:
    """Return the controller of BLAS threads, made once because it searches all loaded libraries."""
    return ThreadpoolController()


class _Skinning(torch.autograd.Function):
    """Apply (V, 3, 4) transforms to (V, 3) rest positions; gradients reach the positions alone.

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


@dataclass(frozen=True, eq=False)
class PosedAvatar:
    """An avatar in one pose, as C cameras see it.

    Attributes:
        vertices: of the posed mesh, world, metres.
        gaussians: N of them in the world.
        colors: sRGB, towards each camera.
        bound: the same Gaussians in their triangles' frames, with this pose's residuals.
        displacements: of the mesh in the T-pose before skinning, metres; None: skinning alone.
    """

    vertices: Float[Tensor, "V 3"]
    gaussians: WorldGaussians
    colors: Float[Tensor, "C N 3"]
    bound: BoundGaussians
    displacements: Float[Tensor, "V 3"] | None = None

    __repr__ = one_line


class AvatarModel(Protocol):
    """Any module that can be posed and drawn: teacher, student, baselines."""

    rig: Rig
    training: bool

    def __call__(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> PosedAvatar:
        """Return the avatar in a pose.

        Args:
            camera_centers: centres of projection in the world, metres.
        """

    def train(self, mode: bool = True) -> Any:
        """Set the training mode, as modules do."""

    def eval(self) -> Any:
        """Set the evaluation mode, as modules do."""

    def named_parameters(self) -> Iterable[tuple[str, Tensor]]:
        """Return the learned parameters by name, as modules do."""


@contextmanager
def at_rest(model: AvatarModel | nn.Module) -> Iterator[None]:
    """Run the block without gradients and with the module in its evaluation mode, and restore its mode."""
    # The mode is restored after an error too, so that a training can go on after a failed evaluation.
    was_training = model.training
    model.eval()
    try:
        with torch.no_grad():
            yield
    finally:
        model.train(was_training)
