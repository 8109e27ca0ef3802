"""Pretraining of the student's field on known displacements, without rendering."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.byte_cache import ByteCache
from avatar.data.sequence import AvatarSequence
from avatar.models.networks.deformation_field import show_null_code
from avatar.models.networks.sparse_lookups import MapSampler
from avatar.models.student import Student
from avatar.models.teacher_avatar import TeacherAvatar, assign_front_back
from avatar.rendering.mesh_maps import vertex_normals
from avatar.training.engine.adam import ParameterGroup
from avatar.training.engine.optimization_task import CACHE_BYTES, PretrainConfig, PretrainTask


class PretrainFieldTask(PretrainTask):
    """Fits the field to known displacements at its points: the weighted mean of `|dv - known|`, in units of the maps.

    The known displacements of a training frame are those of the tracked surface, weighted by the track's confidence, or
    without a track those of the teacher's maps.

    Args:
        sequence: of the training frames.
        student: with a field.
        teacher: its track or its maps are the known displacements.
        config: of the steps.
        seed: of the order of poses and of the draws.
        code_lr_factor: learning rate of the frame codes, as a multiple of the field's.
        null_share: share of the poses that are shown with the null code.
    """

    def __init__(
        self,
        sequence: AvatarSequence,
        student: Student,
        teacher: TeacherAvatar,
        config: PretrainConfig,
        seed: int,
        *,
        code_lr_factor: float,
        null_share: float,
    ) -> None:
        field, codes = student.field, student.codes
        assert field is not None and codes is not None, "a student with a field"
        # Field and codes learn, codes at a multiple of the rate.
        groups = [
            ParameterGroup("field", dict(field.named_parameters()), config.lr, config.lr_final_factor),
            ParameterGroup("codes", {"codes": codes.codes}, config.lr * code_lr_factor, config.lr_final_factor),
        ]
        super().__init__(groups, config, len(sequence.train_frames), seed)
        self.sequence, self.student, self.teacher = sequence, student, teacher
        self.field, self.codes = field, codes
        self.null_share = null_share
        if null_share:
            show_null_code(student)
        self._lookup = _MapLookup(teacher, field.points)
        self._known = ByteCache(CACHE_BYTES)
        self.iteration = 0

    def micro_batches(self, iteration: int) -> Sequence[tuple[int, ...]]:
        """Return the numbers of the poses in a step, counted in the training frames."""
        self.iteration = iteration
        return super().micro_batches(iteration)

    def name_of(self, item: tuple[int, ...]) -> str:
        """Return the name of a batch for messages: its frames."""
        return "poses " + " ".join(str(self.sequence.train_frames[k]) for k in item)

    def loss(self, item: tuple[int, ...]) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Return the weighted mean distance of a batch of poses, in units of the maps."""
        frames = self.sequence.train_frames
        # A share of the poses is shown with the null code.
        draws = np.random.default_rng((self.seed, 4, self.iteration)).random(len(item))
        shown = [frames[k] if draw >= self.null_share else None for k, draw in zip(item, draws, strict=True)]
        # (B, 63), (B, K, 3) and (B, K); the L1 distance over x, y, z, weighted by the confidence of the track.
        pose, known, weight = (
            torch.stack(parts) for parts in zip(*(self._training_pair(k) for k in item), strict=True)
        )
        apart = (self.field.at_points(pose, self.codes(shown)) - known).abs().sum(-1)
        loss = (weight * apart).sum() / weight.sum() / self.teacher.config.position_scale
        return loss, {"loss": loss.detach()}

    def _training_pair(self, number: int) -> tuple[Tensor, ...]:
        """Return theta (63,), known displacements (K, 3) at the field's points, metres, and their weights (K,)."""

        def make() -> tuple[Tensor, ...]:
            frame, track = self.sequence.train_frames[number], self.teacher.track
            pose = self.sequence.pose(frame)
            if track is not None:
                found, counts = track.displacements(frame), track.confidence(frame)
                return pose.body_pose, found[self.field.points], counts[self.field.points]
            found = self._lookup(self.teacher.displacement_maps([pose]))[0]
            return pose.body_pose, found, found.new_ones(len(found))

        return self._known.get(number, make)


class _MapLookup:
    """Looks up the teacher's displacement maps at vertices of the template.

    Clothes under other clothes take the displacement shown in front of them, because layers move together. Skin that is
    hidden by more than a centimetre of them gets none.
    """

    def __init__(self, teacher: TeacherAvatar, points: Tensor) -> None:
        rig, size = teacher.rig, teacher.config.out_size
        vertices, normals = rig.vertices[points], vertex_normals(rig.vertices, rig.faces)[points]
        # The lookup of a Gaussian's map, at the points of the field instead.
        sides = assign_front_back(rig, teacher.frame, size, vertices, normals)
        self.sampler = MapSampler(teacher.frame, size, vertices, sides.front)
        hidden = 0.01  # metres behind the surface of the maps
        self.stays = (sides.behind > hidden) & ~rig.cloth_mask[points]

    def __call__(self, maps: Float[Tensor, "B 2 R R 3"]) -> Float[Tensor, "B K 3"]:
        """Return the displacements of maps at the points, metres, 0 on hidden skin."""
        return self.sampler(maps).masked_fill(self.stays[:, None], 0.0)
