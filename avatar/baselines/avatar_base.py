"""Define the base of the baselines, Gaussians on a skinned mesh with residuals of a network, and its training."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor, nn

from avatar.data.sequence import AvatarSequence, Item, camera_centers_of
from avatar.gaussians import BoundGaussians, triangle_frames, view_colors, world_from_frames
from avatar.gaussians.binding import corner_weights
from avatar.models.learned_gaussians import LearnedGaussians
from avatar.models.networks.deformation_field import FrameCodes, show_null_code
from avatar.models.networks.teacher import local_offsets
from avatar.rig.rig import Pose, PosedAvatar, Rig
from avatar.training.engine.adam import ParameterGroup
from avatar.training.engine.photometric_task import ALONE, PhotometricConfig, PhotometricTask, TaskContext
from smplxpp.core.errors import require_between

RESIDUALS = 12
"""Outputs a Gaussian: position 3, log scales 2, quaternion 4, colour 3."""


class Baseline(nn.Module, ABC):
    """An avatar that learns from photographs alone (an `AvatarModel`).

    Attributes:
        rig: of the template.
        gaussians: learned Gaussians on the template.
    """

    rig: Rig
    gaussians: LearnedGaussians

    @abstractmethod
    def forward(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> PosedAvatar:
        """Pose the avatar as cameras with these centres, metres, see it."""

    @abstractmethod
    def groups(self, lr: float, lr_final_factor: float) -> list[ParameterGroup]:
        """Return the learned parameters beside the Gaussians' attributes, in groups with learning rates.

        Args:
            lr: initial rate of networks.
            lr_final_factor: final rate as a share of the initial one.
        """


class ResidualBaseline(Baseline):
    """`x = LBS(R (u + du) + ...)`: residuals of position, scale, rotation and colour on a skinned template.

    Args:
        rig: of the template.
        gaussians: on the template.
        frames: frames with a code.
        code_size: length of each code.
    """

    corner_weights: Tensor
    canonical_from_local: Tensor
    points: Tensor

    def __init__(self, rig: Rig, gaussians: BoundGaussians, frames: Sequence[int], *, code_size: int) -> None:
        super().__init__()
        gaussians.check_topology(rig.faces, "template of the baseline")
        gaussians = gaussians.to(device=rig.device)
        self.rig = rig
        self.gaussians = LearnedGaussians(gaussians)
        self.gaussians.normalise_quats()
        self.codes = FrameCodes(frames, code_size)
        # Constants of the T-pose: where each Gaussian is, and the
        # rotation from its triangle's frame to the canonical axes.
        canonical = triangle_frames(rig.vertices, rig.faces)
        self.register_buffer("corner_weights", corner_weights(gaussians.barycentric), persistent=False)
        self.register_buffer("canonical_from_local", canonical.rotations[gaussians.face_index], persistent=False)
        points = (self.corner_weights[..., None] * canonical.corners[gaussians.face_index]).sum(1)
        self.register_buffer("points", points, persistent=False)

    @abstractmethod
    def residuals(self, pose: Pose, code: Float[Tensor, " Z"]) -> Float[Tensor, "N 12"]:
        """Return the outputs in the order of `RESIDUALS`; `code` is that of the frame."""

    def forward(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> PosedAvatar:
        """Pose the avatar as cameras with these centres, metres, see it."""
        position_scale = 0.05  # metres of displacement for an output of 1, as the teacher's
        # Frames without a code take the null code, as the student's.
        code = self.codes([pose.frame if pose.frame in self.codes.row else None])[0]
        position, log_scales, quats, colour = self.residuals(pose, code).split((3, 2, 4, 3), dim=-1)
        # Networks give displacements in canonical axes; they are turned into the triangle's frame, which then carries
        # them to the pose. Scales, quaternions and colours are added as they are.
        bound = self.gaussians()
        bound = replace(
            bound,
            offset=bound.offset + local_offsets(position_scale * position, self.canonical_from_local),
            log_scales=bound.log_scales + log_scales,
            quats=bound.quats + quats,
            dc=bound.dc + colour,
        )
        # Colours are evaluated at detached means, so that the direction of view does not pull Gaussians elsewhere.
        vertices = self.rig.skin(pose)
        frames = triangle_frames(vertices, self.rig.faces)
        world = world_from_frames(bound, frames)
        return PosedAvatar(vertices, world, view_colors(bound, frames, world.means.detach(), camera_centers), bound)

    def groups(self, lr: float, lr_final_factor: float) -> list[ParameterGroup]:
        """Return networks and codes as one group."""
        own = {name: p for name, p in self.named_parameters() if not name.startswith("gaussians.")}
        return [ParameterGroup("networks", own, lr, lr_final_factor)]


@dataclass(frozen=True, kw_only=True)
class PhotographConfig(PhotometricConfig):
    """Options of a baseline's training on photographs.

    Attributes:
        null_share: share of the poses that are shown with the null code.
    """

    null_share: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_between("baseline: null_share", self.null_share, 0.0, 1.0)


class PhotographTask(PhotometricTask):
    """`L_rec` of a baseline's renderings against photographs."""

    config: PhotographConfig

    def __init__(
        self, sequence: AvatarSequence, model: Baseline, config: PhotographConfig, context: TaskContext = ALONE
    ) -> None:
        groups = model.groups(config.lr, config.lr_final_factor)
        super().__init__(sequence, model, config, groups, context)
        if config.null_share:
            show_null_code(model)
        for group in groups:
            # A configuration that leaves the attributes as they are freezes all of them, a texture's colours too.
            for value in group.parameters.values():
                value.requires_grad_(True)

    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Return the loss of one frame, and its terms as numbers."""
        # With probability `null_share` a pose is shown with the null
        # code, which thereby learns to stand for unseen frames.
        views = self.views(item)
        pose = self.sequence.pose(item.frame)
        if self.config.null_share and self.generator(item.frame).random() < self.config.null_share:
            pose = pose.without_code()
        total, terms, _ = self.compared(self.model(pose, camera_centers_of(views)), views)
        return total, {"loss": total.detach(), **terms}
