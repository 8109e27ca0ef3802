"""Networks that learn known displacements before anything is rendered: many poses a step, at little cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avatar.gaussians.binding import on_triangles
from avatar.models.map_sampling import MapSampler
from avatar.models.map_sides import map_sides
from avatar.models.rig import Motion
from avatar.models.student import Student
from avatar.models.teacher import Residuals
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked import Track
from avatar.render.mesh_maps import vertex_normals
from avatar.training.byte_cache import ByteCache
from avatar.training.gradient_task import GradientTask, OptimiserConfig, ParameterGroup
from avatar.training.sequence import AvatarSequence
from smplxpp.core.errors import InputError

KNOWN_BYTES = 1 << 30
"""Of inputs and known displacements that are kept."""
BEYOND = 0.25
"""Imagined poses reach beyond the two that they lie between by this share of the way."""
HIDDEN = 0.01
"""Metres behind the maps' surface from which a point is not the one that they show."""


@dataclass(frozen=True, kw_only=True)
class PretrainConfig:
    """Choices of a training without rendering.

    Attributes:
        iterations: steps of Adam. batch: poses a step.
        rate, final, warmup, betas: of Adam, see `OptimiserConfig`.
    """

    iterations: int
    batch: int = 1
    rate: float = 5e-4
    final: float = 0.05
    warmup: int = 0
    betas: tuple[float, float] = (0.9, 0.999)

    def __post_init__(self) -> None:
        for name, least in (("iterations", 1), ("batch", 1), ("warmup", 0)):
            if not getattr(self, name) >= least:
                raise InputError(
                    f"pretraining: {name}", expected=f"at least {least}", received=str(getattr(self, name))
                )

    @property
    def evaluate_every(self) -> int:
        """Nothing is measured on the way."""
        return self.iterations

    def optimiser(self) -> OptimiserConfig:
        """Of these steps."""
        return OptimiserConfig(iterations=self.iterations, warmup=self.warmup, betas=self.betas)

    def shortened(self, share: float) -> PretrainConfig:
        """With `share` of the steps."""
        return replace(self, iterations=max(1, round(share * self.iterations)))


class _PretrainTask(GradientTask):
    """One batch a step, in an order that changes from epoch to epoch."""

    def __init__(self, groups: Sequence[ParameterGroup], config: PretrainConfig, count: int, seed: int) -> None:
        super().__init__(groups, config.optimiser())
        self.batch, self.count, self.seed = min(config.batch, count), count, seed

    def items(self, iteration: int) -> Sequence[tuple[int, ...]]:
        """The numbers of the poses of a step: each at most once an epoch, what batches leave over in another one."""
        per_epoch = self.count // self.batch
        epoch, place = divmod(iteration, per_epoch)
        order = np.random.default_rng((self.seed, 3, epoch)).permutation(self.count)
        return [tuple(order[place * self.batch : (place + 1) * self.batch].tolist())]

    def evaluate(self, iteration: int) -> Mapping[str, Any]:
        """Nothing: no view is rendered."""
        return {"mean": {}}


class PretrainTeacherTask(_PretrainTask):
    """Displacements that are known, `mean |dU - known|` where the Gaussians look the maps up; or all residuals zero.

    Args:
        teacher: whose networks learn.
        track: the displacements that are known, of a teacher whose other residuals start at zero; None: every residual
            is to be zero.
    """

    def __init__(
        self, sequence: AvatarSequence, teacher: TeacherAvatar, config: PretrainConfig, seed: int, track: Track | None
    ) -> None:
        networks = ParameterGroup("networks", dict(teacher.networks.named_parameters()), config.rate, config.final)
        super().__init__([networks], config, len(sequence.train_frames), seed)
        self.sequence, self.teacher, self.track = sequence, teacher, track
        self._known = ByteCache(KNOWN_BYTES)

    def name_of(self, item: tuple[int, ...]) -> str:
        return "frames " + " ".join(str(self.sequence.train_frames[k]) for k in item)

    def loss(self, item: tuple[int, ...]) -> tuple[Tensor, Mapping[str, float]]:
        """Of a batch of frames."""
        frames = [self.sequence.train_frames[k] for k in item]
        if self.track is None:
            maps = [self._all_residuals(frame) for frame in frames]
            loss = sum(m.shape.float().abs().mean() + m.colour.float().abs().mean() for m in maps) / len(maps)
            return loss, {"loss": float(loss.detach())}
        inputs, known = zip(*(self._of(frame) for frame in frames), strict=True)
        with self.autocast():
            found = self.teacher.networks.positions(torch.cat(inputs), self.teacher.semantics)
        units = torch.stack(known) / self.teacher.config.position_scale
        loss = (self.teacher.sampler(found.float()) - units).abs().sum(-1).mean()
        return loss, {"loss": float(loss.detach())}

    def _of(self, frame: int) -> tuple[Tensor, ...]:
        """Input map, and the known displacements of the Gaussians, (N, 3) metres along the axes of the T-pose."""

        def make() -> tuple[Tensor, ...]:
            corners = self.track.displacements(frame)[self.sequence.rig.faces[self.teacher.gaussians.face_index]]
            inputs = self.teacher.position_input(self.sequence.motion(frame))
            return inputs, on_triangles(corners, self.teacher.gaussians.barycentric)

        return self._known.get(frame, make)

    def _all_residuals(self, frame: int) -> Residuals:
        cameras = self.sequence.cameras(frame, 0, 1, self.seed)
        eyes = np.stack([self.sequence.capture.cameras[name].position for name in cameras])
        eyes = torch.tensor(eyes, dtype=torch.float32, device=self.sequence.device)
        with self.autocast():
            return self.teacher.residual_maps(self.sequence.motion(frame), eyes)


class PretrainFieldTask(_PretrainTask):
    """`L_non` where the field is evaluated: its displacements against the teacher's at the same points.

    Those of a training frame are the surface that was followed, where there is one, else the teacher's maps. The
    teacher can be asked about any pose. Imagined ones, on the lines between the poses of two training frames and a
    little beyond, are shown with the null code, which so learns what lies between the frames.

    Args:
        student: with a field. teacher: whose maps are learned.
        code_rate: rate of the frame codes, as a multiple of the field's.
        null_share: of the training poses that are shown with the null code too.
        imagined: number of imagined poses.
    """

    def __init__(
        self, sequence: AvatarSequence, student: Student, teacher: TeacherAvatar, config: PretrainConfig, seed: int,
        *, code_rate: float, null_share: float, imagined: int,
    ) -> None:  # fmt: skip
        groups = [
            ParameterGroup("field", dict(student.field.named_parameters()), config.rate, config.final),
            ParameterGroup("codes", {"codes": student.codes.codes}, config.rate * code_rate, config.final),
        ]
        frames = sequence.train_frames
        super().__init__(groups, config, len(frames) + imagined, seed)
        self.sequence, self.student, self.teacher = sequence, student, teacher
        self.null_share = null_share
        self._lookup = _MapLookup(teacher, student.field.points)
        self._known = ByteCache(KNOWN_BYTES)
        self.iteration = 0

    def items(self, iteration: int) -> Sequence[tuple[int, ...]]:
        self.iteration = iteration
        return super().items(iteration)

    def name_of(self, item: tuple[int, ...]) -> str:
        frames = self.sequence.train_frames
        return "poses " + " ".join(str(frames[k]) if k < len(frames) else f"imagined {k - len(frames)}" for k in item)

    def loss(self, item: tuple[int, ...]) -> tuple[Tensor, Mapping[str, float]]:
        """Of a batch of poses."""
        frames = self.sequence.train_frames
        draws = np.random.default_rng((self.seed, 4, self.iteration)).random(len(item))
        shown = [
            frames[k] if k < len(frames) and draw >= self.null_share else None
            for k, draw in zip(item, draws, strict=True)
        ]
        pose, known = (torch.stack(parts) for parts in zip(*(self._of(k) for k in item), strict=True))
        found = self.student.field.at_points(pose, self.student.codes(shown))
        loss = (found - known).abs().sum(-1).mean() / self.teacher.config.position_scale
        return loss, {"loss": float(loss.detach())}

    def _of(self, number: int) -> tuple[Tensor, ...]:
        """theta (63,), and the teacher's displacements (K, 3) metres at the field's points."""

        def make() -> tuple[Tensor, ...]:
            motion, track = self._motion(number), self.teacher.track
            if motion.frame is not None and track is not None:
                return motion.pose, track.displacements(motion.frame)[self.student.field.points]
            return motion.pose, self._lookup(self.teacher.displacement_maps([motion]))[0]

        return self._known.get(number, make)

    def _motion(self, number: int) -> Motion:
        frames, sequence = self.sequence.train_frames, self.sequence
        if number < len(frames):
            return sequence.motion(frames[number])
        noise = np.random.default_rng((self.seed, 5, number))
        a, b = (sequence.capture.params(frames[k]) for k in noise.integers(len(frames), size=2))
        share = noise.uniform(-BEYOND, 1.0 + BEYOND)
        return sequence.rig.motion(replace(a, body_pose=a.body_pose + share * (b.body_pose - a.body_pose)))


class _MapLookup:
    """The teacher's displacements at vertices of the template.

    Clothes under other clothes take what is shown in front of them: layers move together. Skin that is not shown stays.
    """

    def __init__(self, teacher: TeacherAvatar, points: Tensor) -> None:
        rig, size = teacher.rig, teacher.config.out_size
        vertices, normals = rig.vertices[points], vertex_normals(rig.vertices, rig.faces)[points]
        sides = map_sides(rig, teacher.frame, size, vertices, normals)
        self.sampler = MapSampler(teacher.frame, size, vertices, sides.front)
        self.stays = (sides.behind > HIDDEN) & ~rig.cloth_mask[points]

    def __call__(self, maps: Tensor) -> Tensor:
        """(B, 2, R, R, 3) -> (B, K, 3)."""
        return self.sampler(maps).masked_fill(self.stays[:, None], 0.0)
