"""The posed avatar, and the protocol of every model that can be posed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.gaussians.binding import BoundGaussians, WorldGaussians
from avatar.rig.rig import Pose, Rig


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
