"""The teacher's training: residual maps that make the Gaussians of every frame look like its photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from avatar.models.posed import PosedAvatar
from avatar.models.teacher import Residuals
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.training.gradient_task import ParameterGroup
from avatar.training.sequence import AvatarSequence, Item, eyes_of
from avatar.training.view_task import ViewConfig, ViewTask


@dataclass(frozen=True, kw_only=True)
class FitTeacherConfig(ViewConfig):
    """Choices of the teacher's training.

    Attributes:
        iterations: 600k in the paper. pretrain: steps before those that teach networks which start at random to give
            zero residuals, `mean |maps|`; 5k in Animatable Gaussians.
        view_jitter: standard deviation of the noise on the directions that colour sees, as a share of the distance.
        displacement: weight of `mean |dU|^2` over the Gaussians, in units of the map.
    """

    iterations: int = 600_000
    pretrain: int = 5_000
    view_jitter: float = 0.1
    displacement: float = 0.0


class TeacherTask(ViewTask):
    """`L_rec` of the teacher's renderings; the first `pretrain` of the iterations ask for zero residuals."""

    def __init__(self, sequence: AvatarSequence, teacher: TeacherAvatar, config: FitTeacherConfig, **options: Any):
        networks = ParameterGroup("networks", dict(teacher.networks.named_parameters()), config.rate, config.final)
        super().__init__(sequence, teacher, config, [networks], **options)
        self.teacher, self.config = teacher, config

    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, float]]:
        """Of one frame: the networks run once for all its cameras."""
        views = self.views(item)
        motion, eyes = self.sequence.motion(item.frame), eyes_of(views)
        maps = self._maps(item, eyes)
        if self.iteration < self.config.pretrain:
            size = maps.shape.abs().mean() + maps.colour.abs().mean()
            return size, {"residuals": float(size.detach())}
        posed = self.teacher.posed(motion, eyes, maps)
        total, terms, _ = self.compared(posed, views)
        if self.config.displacement:
            moved = maps.shape[..., :3].square().mean()
            total = total + self.config.displacement * moved
        return total, {"loss": float(total.detach()), **terms, "displacement_mm": _millimetres(posed, self.teacher)}

    def _maps(self, item: Item, eyes: Tensor) -> Residuals:
        motion = self.sequence.motion(item.frame)
        noise = self.generator(item.frame).normal(size=eyes.shape) * self.config.view_jitter
        center = motion.root_from_world.inverse()[:3, 3]
        away = (eyes - center).norm(dim=-1, keepdim=True)
        jittered = eyes + away * torch.tensor(noise, dtype=eyes.dtype, device=eyes.device)
        with self.autocast():
            maps = self.teacher.residual_maps(motion, jittered)
        return Residuals(maps.shape.float(), maps.colour.float(), maps.position_scale)


def _millimetres(posed: PosedAvatar, teacher: TeacherAvatar) -> float:
    """Mean length of the Gaussians' displacement, mm."""
    with torch.no_grad():
        return 1e3 * float((posed.bound.offset - teacher.gaussians.offset).norm(dim=-1).mean())
