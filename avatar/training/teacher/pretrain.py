"""Pretraining of the teacher's networks on the tracked surface, or on zero residuals, without rendering."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from avatar.data.byte_cache import ByteCache
from avatar.data.sequence import AvatarSequence
from avatar.gaussians.binding import on_triangles
from avatar.models.networks.teacher import Residuals
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked_surface import Track
from avatar.training.engine.optimization_task import ParameterGroup
from avatar.training.engine.pretraining import CACHE_BYTES, PretrainConfig, PretrainTask


class PretrainTeacherTask(PretrainTask):
    """Fits the networks to known displacements: `mean |dU - known|` where the Gaussians look the maps up.

    The mean is weighted by the track's confidence, in units of the maps. Without a track all residuals are fitted to 0.

    Args:
        sequence: of the training frames.
        teacher: whose networks learn.
        config: of the steps.
        seed: of the order of frames.
        track: the known displacements; the teacher's other residuals start at zero. None: zero residuals.
    """

    def __init__(
        self, sequence: AvatarSequence, teacher: TeacherAvatar, config: PretrainConfig, seed: int, track: Track | None
    ) -> None:
        networks = ParameterGroup(
            "networks", dict(teacher.networks.named_parameters()), config.lr, config.lr_final_factor
        )
        super().__init__([networks], config, len(sequence.train_frames), seed)
        self.sequence, self.teacher, self.track = sequence, teacher, track
        self._known = ByteCache(CACHE_BYTES)

    def name_of(self, item: tuple[int, ...]) -> str:
        """Return the name of a batch for messages: its frames."""
        return "frames " + " ".join(str(self.sequence.train_frames[k]) for k in item)

    def loss(self, item: tuple[int, ...]) -> tuple[Tensor, Mapping[str, float]]:
        """Return the loss of a batch of frames, in units of the maps."""
        frames = [self.sequence.train_frames[k] for k in item]
        # Without a track: the mean size of all residuals.
        if self.track is None:
            maps = [self._all_residuals(frame) for frame in frames]
            sizes = [m.shape.float().abs().mean() + m.colour.float().abs().mean() for m in maps]
            loss = sum(sizes[1:], sizes[0]) / len(maps)
            return loss, {"loss": float(loss.detach())}
        # With a track: weighted L1 distance at the Gaussians.
        inputs, known, weights = zip(*(self._training_pair(frame, self.track) for frame in frames), strict=True)
        with self.autocast():
            found = self.teacher.networks.positions(torch.cat(inputs), self.teacher.semantics)
        units = torch.stack(known) / self.teacher.config.position_scale
        apart, weight = (self.teacher.sampler(found.float()) - units).abs().sum(-1), torch.stack(weights)
        loss = (weight * apart).sum() / weight.sum()
        return loss, {"loss": float(loss.detach())}

    def _training_pair(self, frame: int, track: Track) -> tuple[Tensor, ...]:
        """Return the input map of a frame, the Gaussians' known displacements (N, 3) and their weights (N,).

        Displacements are in metres along the axes of the T-pose.
        """

        def make() -> tuple[Tensor, ...]:
            # Interpolate displacements and confidences from the vertices to the Gaussians.
            known = torch.cat([track.displacements(frame), track.confidence(frame)[:, None]], dim=1)
            corners = known[self.sequence.rig.faces[self.teacher.gaussians.face_index]]
            at_gaussians = on_triangles(corners, self.teacher.gaussians.barycentric)
            inputs = self.teacher.position_input(self.sequence.pose(frame))
            return inputs, at_gaussians[:, :3].contiguous(), at_gaussians[:, 3].contiguous()

        return self._known.get(frame, make)

    def _all_residuals(self, frame: int) -> Residuals:
        """Return all residual maps of a frame, seen by one of its cameras."""
        # The colour network needs a viewpoint; any camera serves, because the target is zero for all of them.
        cameras = self.sequence.cameras(frame, 0, 1, self.seed)
        positions = np.stack([self.sequence.capture.cameras[name].position for name in cameras])
        camera_centers = torch.tensor(positions, dtype=torch.float32, device=self.sequence.device)
        with self.autocast():
            return self.teacher.residual_maps(self.sequence.pose(frame), camera_centers)
