"""Corrections of the tracked clothes in all frames at once, learned together with the Gaussians that they carry.

The tracker's Gaussians were fitted to one frame and stay fixed while it solves the others, one by one, each from its
own photographs. What they have wrong (a stripe a pixel off, a shade) every frame's surface makes good separately.
Here one set of Gaussians has to explain all frames, and the surfaces move where that alone does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from avatar.data.sequence import AvatarSequence, Item, camera_centers_of
from avatar.gaussians.binding import BoundGaussians
from avatar.models.tracked_surface import Track, TrackedAvatar
from avatar.training.engine.adam import ParameterGroup
from avatar.training.engine.loop import Progress
from avatar.training.engine.photometric_task import ALONE, PhotometricTask, TaskContext
from avatar.training.engine.session import JOINT, Session
from avatar.training.tracking.config import JointConfig


class JointTask(PhotometricTask):
    """Learns the Gaussians' attributes and corrections of the clothes' control points in every tracked frame.

    The loss of a view of frame t is the fit's, and a membrane energy of the corrections c_t of what was tracked:

        L = L_rec(render(d_t + c_t), photograph) + smoothness * mean |c_t,i - c_t,j|^2

    Args:
        sequence: the training frames and views.
        avatar: the Gaussians on a cage of control points of its own.
        track: the tracked surface d, which the cage of the avatar samples.
        config: of the steps.
        context: of the training.
    """

    sequence: AvatarSequence

    def __init__(
        self,
        sequence: AvatarSequence,
        avatar: TrackedAvatar,
        track: Track,
        config: JointConfig,
        context: TaskContext = ALONE,
    ) -> None:
        self.tracked = track.on(avatar.cage)
        self.corrections = nn.Parameter(torch.zeros_like(self.tracked.controls))
        rate = config.lr * config.rate
        group = ParameterGroup("corrections", {"corrections": self.corrections}, rate, lr_final_factor=0.1)
        super().__init__(sequence, avatar, config.photometric(len(sequence.train_frames)), [group], context)
        self.avatar, self.smoothness = avatar, config.smoothness
        # Skin, shoes and hair stay: joints place them better than photographs of a few hundred pixels; so, in part, do
        # clothes that lie on the skin.
        self.learns = ((~avatar.cage.off_clothes).float() * avatar.cage.looseness(config.tight_reach))[:, None]

    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Return the loss of a frame's views and its terms."""
        views, row = self.views(item), self.tracked.row[item.frame]
        correction = self.learns * self.corrections[row]
        controls = self.tracked.controls[row] + correction
        posed = self.avatar.displaced(self.sequence.pose(item.frame), camera_centers_of(views), controls)
        total, terms, _ = self.compared(posed, views)
        total = total + self.smoothness * self.avatar.cage.roughness(correction)
        return total, {"loss": total.detach(), **terms}

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Return no figures: the control points know the training frames alone."""
        return {"mean": {}}

    def track(self) -> Track:
        """Return the corrected surface; what the tracker expects of its errors holds for it as well."""
        corrected = self.tracked.controls + self.learns * self.corrections.detach()
        return replace(self.tracked, controls=corrected)


def correct_jointly(
    sequence: AvatarSequence, gaussians: BoundGaussians, track: Track, config: JointConfig, session: Session
) -> tuple[BoundGaussians, Track, Progress]:
    """Correct a tracked surface and its Gaussians by the photographs of all training frames at once.

    Several processes share the frames of a step.

    Args:
        sequence: the training frames and views.
        gaussians: on the template, with which the surface was tracked.
        track: the tracked surface.
        config: of the steps.
        session: of the training; a stopped one continues from its checkpoint.

    Returns:
        The Gaussians and the surface, and the progress of the steps.
    """
    count = min(config.control_points, len(sequence.rig.vertices))
    avatar = TrackedAvatar(sequence.rig, gaussians, count)
    task = JointTask(sequence, avatar, track, config, session.context)
    progress = session.within(JOINT).run(lambda: task, task.config, keep_end=True)
    return avatar.gaussians.snapshot(), task.track(), progress
