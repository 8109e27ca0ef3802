"""Pretrain the student's field on known displacements, without rendering; render the teacher as its target."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.byte_cache import ByteCache
from avatar.data.sequence import AvatarSequence, camera_centers_of
from avatar.data.views import View
from avatar.losses.deformation import semantic_labels
from avatar.losses.reconstruction import Target
from avatar.models.networks.deformation_field import show_null_code
from avatar.models.networks.sparse_lookups import MapSampler
from avatar.models.student import Student
from avatar.models.teacher_avatar import TeacherAvatar, assign_front_back
from avatar.rendering.avatar_view import render_view
from avatar.rendering.mesh_maps import MeshMapsTensor, front_back_maps, vertex_normals
from avatar.rig.rig import PosedAvatar
from avatar.training.engine.adam import ParameterGroup
from avatar.training.engine.optimization_task import CACHE_BYTES, PretrainConfig, PretrainTask


@dataclass(frozen=True, eq=False)
class DistillationTarget:
    """Targets of the student in one view.

    Attributes:
        target: the teacher's image, opacity and, if requested, normals.
        labels: its semantic map.
    """

    target: Target
    labels: Float[Tensor, "H W 3"]


class DistillationTargets:
    """Computes targets with the frozen teacher and caches the latest used ones in half precision.

    Args:
        teacher: its weights are not changed.
        sequence: of the frames.
        eps2d: see `rasterize`.
        tau: of the semantic labels, radians a metre.
        normals: whether targets have normals.
        max_bytes: bound of the cache.
        autocast: precision of the teacher's networks.
    """

    def __init__(
        self,
        teacher: TeacherAvatar,
        sequence: AvatarSequence,
        *,
        eps2d: float,
        tau: float,
        normals: bool,
        max_bytes: int = 2 << 30,
        autocast: Callable[[], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        self.teacher, self.sequence = teacher.requires_grad_(False), sequence
        self.eps2d, self.normals, self.autocast = eps2d, normals, autocast
        self.labels = semantic_labels(sequence.rig, teacher.gaussians(), tau=tau)
        self._cache = ByteCache(max_bytes)

    def displacements(self, frame: int) -> Float[Tensor, "2 R R 3"]:
        """Return the teacher's position maps dU of a frame, metres; with a track, maps of the tracked surface."""

        def make() -> tuple[Tensor, ...]:
            if self.teacher.track is not None:
                return (self._maps.interpolate(self.teacher.track.displacements(frame)).half(),)
            with self.autocast():
                return (self.teacher.displacement_maps([self.sequence.pose(frame)])[0].half(),)

        return self._cache.get(("maps", frame), make)[0].float()

    @cached_property
    def _maps(self) -> MeshMapsTensor:
        """Maps of the T-pose, of the size of the teacher's."""
        rig, teacher = self.sequence.rig, self.teacher
        return front_back_maps(rig.vertices, rig.faces, teacher.frame, size=teacher.config.out_size)

    def of_views(self, frame: int, views: Sequence[View]) -> list[DistillationTarget]:
        """Return the targets of a frame's views, rendered where the cache has none."""
        keys = [(frame, view.name, view.camera.width, view.camera.height) for view in views]
        # Read the cached ones first: new ones may evict them.
        found = {k: self._cache.get(key, tuple) for k, key in enumerate(keys) if key in self._cache}
        # Render the missing views with one evaluation of the teacher.
        missing = [k for k in range(len(keys)) if k not in found]
        if missing:
            with torch.no_grad():
                camera_centers = camera_centers_of([views[k] for k in missing])
                pose = self.sequence.pose(frame)
                with self.autocast():
                    maps = self.teacher.residual_maps(pose, camera_centers)
                posed = self.teacher.posed(pose, camera_centers, maps.float())
                for index, k in enumerate(missing):
                    draw = partial(self._draw, posed, index, views[k])
                    found[k] = self._cache.get(keys[k], draw)
        return [_target(found[k]) for k in range(len(keys))]

    def _draw(self, posed: PosedAvatar, index: int, view: View) -> tuple[Tensor, ...]:
        seen = render_view(
            posed, index, view, self.sequence.background, eps2d=self.eps2d, normals=self.normals, extra=self.labels
        )
        assert seen.extra is not None
        tensors = [seen.image, seen.alpha, seen.extra]
        if seen.normals is not None:
            # Normals of pixels that are mostly background mix with it; 0 marks a pixel without a normal.
            tensors.append(seen.normals * (seen.alpha > 0.5)[..., None])
        return tuple(tensor.half() for tensor in tensors)


def _target(tensors: tuple[Tensor, ...]) -> DistillationTarget:
    image, alpha, labels, *normals = (tensor.float() for tensor in tensors)
    return DistillationTarget(Target(image, alpha, normals[0] if normals else None), labels)


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
