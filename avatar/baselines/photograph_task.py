"""Train a baseline on photographs alone, with the shared loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from avatar.baselines.avatar_base import Baseline
from avatar.data.sequence import AvatarSequence, Item, camera_centers_of
from avatar.models.networks.deformation_field import show_null_code
from avatar.training.engine.photometric_task import ALONE, PhotometricConfig, PhotometricTask, TaskContext
from smplxpp.core.validation import require_between


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

    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, float]]:
        """Return the loss of one frame, and its terms as numbers."""
        # With probability `null_share` a pose is shown with the null
        # code, which thereby learns to stand for unseen frames.
        views = self.views(item)
        pose = self.sequence.pose(item.frame)
        if self.config.null_share and self.generator(item.frame).random() < self.config.null_share:
            pose = pose.without_code()
        total, terms, _ = self.compared(self.model(pose, camera_centers_of(views)), views)
        return total, {"loss": float(total.detach()), **terms}
