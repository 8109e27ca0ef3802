"""The teacher's renderings, labels and maps of the training frames as targets of the student, cached in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.byte_cache import ByteCache
from avatar.data.sequence import AvatarSequence, camera_centers_of
from avatar.data.views import View
from avatar.losses.deformation import semantic_labels
from avatar.losses.reconstruction import Target
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.rendering.avatar_view import render_view
from avatar.rendering.mesh_maps import MeshMapsTensor, front_back_maps
from avatar.rig.rig import PosedAvatar


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
