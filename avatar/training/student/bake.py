"""The bake: the student's field, frame codes and attributes learn from the teacher's maps and images."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.sequence import AvatarSequence, Item, camera_centers_of
from avatar.data.views import View
from avatar.gaussians.binding import BoundGaussians
from avatar.losses.deformation import TAU, DisplacementLoss, semantic_labels, vertex_labels
from avatar.models.networks.deformation_field import show_null_code
from avatar.models.networks.pose_dependence import PoseRegression
from avatar.models.student import Student, StudentConfig
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.rendering.avatar_view import Rendering
from avatar.rendering.mesh_maps import mesh_maps
from avatar.rig.rig import Pose, PosedAvatar
from avatar.training.engine.adam import ParameterGroup
from avatar.training.engine.loop import Progress
from avatar.training.engine.optimization_task import PretrainConfig
from avatar.training.engine.photometric_task import (
    ALONE,
    PhotometricConfig,
    PhotometricTask,
    TaskContext,
    with_surface_normals,
)
from avatar.training.engine.processes import Distributed
from avatar.training.engine.resources import fixed_seed
from avatar.training.engine.session import PRETRAIN, Session
from avatar.training.student.pretrain import DistillationTargets, PretrainFieldTask
from avatar.training.student.regress_poses import regress_poses
from smplxpp.core.errors import require_at_least, require_between, require_choice


@dataclass(frozen=True, kw_only=True)
class BakeConfig(PhotometricConfig):
    """Choices of the bake: `L_bak = L_rec + a L_non + b L_sem`.

    Attributes:
        iterations: 30k in the paper.
        attributes: multiple of the attributes' rates; the paper refines them.
        images: targets of the renderings: the "teacher"'s, or "photographs".
        pretrain: pretraining of the field without rendering; None, as in the paper: none.
        regression: replace the field in new poses by a ridge regression from the pose to the surfaces of the training
            frames (`regress_poses`), fitted to the pretrained field first and to the trained one at the end.
        nonrigid: a, weight of `DisplacementLoss`.
        semantic: b, weight of the L1 distance of semantic maps.
        semantic_map: what is drawn with the student's labels: its "mesh", as in the paper, whose gradients reach the
            field alone; or its "gaussians", which are drawn with the image.
        tau: of the semantic labels, radians a metre.
        code_lr_factor: learning rate of the frame codes, as a multiple of `lr`.
        null_share: share of the poses that are shown as new ones: with the null code, which is trained by this, or with
            the regression; loose clothes lie where the student has them in the frame.
        pose_noise: standard deviation of the noise on the field's theta, radians; skinning has the true pose.
    """

    iterations: int = 30_000
    attributes: float = 0.5
    images: str = "teacher"
    pretrain: PretrainConfig | None = None
    regression: bool = False
    nonrigid: float = 0.1
    semantic: float = 1.0
    semantic_map: str = "gaussians"
    tau: float = TAU
    code_lr_factor: float = 1.0
    null_share: float = 0.0
    pose_noise: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("bake: images", self.images, ("teacher", "photographs"))
        require_choice("bake: semantic_map", self.semantic_map, ("mesh", "gaussians"))
        for name in ("nonrigid", "semantic", "code_lr_factor", "pose_noise"):
            require_at_least(f"bake: {name}", getattr(self, name), 0.0)
        require_between("bake: null_share", self.null_share, 0.0, 1.0)


class BakeTask(PhotometricTask):
    """Trains field, frame codes and attributes on the teacher; without one, on the photographs alone.

    Args:
        sequence: of the training frames.
        student: with a field; without one only its attributes learn.
        config: of the bake.
        context: perceptual distance, processes, previews.
        teacher: frozen; None: `L_rec` alone, on photographs.
    """

    config: BakeConfig
    sequence: AvatarSequence

    def __init__(
        self,
        sequence: AvatarSequence,
        student: Student,
        config: BakeConfig,
        context: TaskContext = ALONE,
        *,
        teacher: TeacherAvatar | None = None,
    ) -> None:
        # Parameters: field and codes; the base class adds the attributes.
        groups = []
        if student.field is not None and student.codes is not None:
            groups = [
                ParameterGroup("field", dict(student.field.named_parameters()), config.lr, config.lr_final_factor),
                ParameterGroup(
                    "codes", {"codes": student.codes.codes}, config.lr * config.code_lr_factor, config.lr_final_factor
                ),
            ]
        super().__init__(sequence, student, config, groups, context)
        self.student, self.targets = student, None
        if config.null_share and student.regression is None:
            show_null_code(student)
        # Targets and losses of a bake with a teacher.
        if teacher is not None:
            self.targets = DistillationTargets(
                teacher,
                sequence,
                eps2d=config.eps2d,
                tau=config.tau,
                normals=bool(config.weights.normal),
                autocast=self.autocast,
            )
            teacher_config = teacher.config
            self.displacement_loss = DisplacementLoss(
                sequence.rig, teacher.frame, teacher_config.out_size, teacher_config.position_scale
            )
            self.of_mesh = config.semantic_map == "mesh"
            # Labels e = c + sin(tau v) of what is drawn: the mesh's vertices (V, 3) or the student's Gaussians (N,
            # 3).
            self.labels = (
                vertex_labels(sequence.rig, tau=config.tau)
                if self.of_mesh
                else semantic_labels(sequence.rig, student.gaussians(), tau=config.tau)
            )

    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Return `L_rec + nonrigid L_non + semantic L_sem` of one frame and its terms."""
        pose = self._augmented_pose(self.sequence.pose(item.frame), item.frame)
        views = self.views(item)
        posed = self.student(pose, camera_centers_of(views))
        # Without a teacher: the photometric loss on photographs alone.
        if self.targets is None:
            total, terms, _ = self.compared(posed, views)
            return total, {"loss": total.detach(), **terms}
        # L_rec on the teacher's images or on photographs.
        semantic, imitates = bool(self.config.semantic), self.config.images == "teacher"
        shown = self.targets.of_views(item.frame, views) if semantic or imitates else []
        targets = [one.target for one in shown] if imitates else None
        total, terms, renderings = self.compared(
            posed, views, targets, extra=None if self.of_mesh or not semantic else self.labels
        )
        # L_sem: L1 distance of the semantic maps.
        if semantic:
            drawn = self._mesh_labels(posed, views) if self.of_mesh else map(_labels, renderings)
            differences = [(own - one.labels).abs().mean() for own, one in zip(drawn, shown, strict=True)]
            terms["semantic"] = torch.stack(differences).mean().detach()
            total = total + self.config.semantic * torch.stack(differences).mean()
        # L_non: distance of the mesh's displacement from the teacher's maps.
        if self.config.nonrigid and posed.displacements is not None:
            nonrigid = self.displacement_loss(posed.displacements, self.targets.displacements(item.frame))
            terms["nonrigid"] = nonrigid.detach()
            total = total + self.config.nonrigid * nonrigid
        return total, {"loss": total.detach(), **terms}

    def _mesh_labels(self, posed: PosedAvatar, views: Sequence[View]) -> Iterator[Tensor]:
        """Yield the semantic map of the student's mesh in each view, with gradients to its vertices."""
        for view in views:
            maps = mesh_maps(posed.vertices, self.sequence.rig.faces, view.camera)
            yield maps.interpolate(self.labels)

    def _augmented_pose(self, pose: Pose, frame: int) -> Pose:
        """Return the pose that the field sees: a share of them as new ones, with noise on theta."""
        # Random numbers depend on seed, iteration and frame alone, so that a continued training draws the same
        # ones.
        noise = self.generator(frame)
        if self.config.null_share and noise.random() < self.config.null_share:
            pose = new_pose_as_seen(self.student, self.sequence, frame)
        if self.config.pose_noise:
            # Noise on theta regularises the field like a penalty on its slope with the pose; skinning keeps the true
            # pose.
            moved = torch.tensor(noise.normal(size=len(pose.body_pose)) * self.config.pose_noise)
            pose = replace(pose, body_pose=pose.body_pose + moved.to(pose.body_pose))
        return pose


def new_pose_as_seen(student: Student, sequence: AvatarSequence, frame: int) -> Pose:
    """Return the pose of a training frame marked as new, with its loose clothes where the student has them in it.

    A simulation swings a centimetre beside the photographs, and Gaussians that learn their colours there lose every
    pattern finer than that.
    """
    with torch.no_grad():
        seen = student.displacements(sequence.pose(frame))
    return sequence.as_new_pose(frame, seen=seen)


def _labels(rendering: Rendering) -> Float[Tensor, "H W 3"]:
    """Return the semantic map that was rendered with an image."""
    assert rendering.extra is not None
    return rendering.extra


def bake(
    sequence: AvatarSequence,
    gaussians: BoundGaussians,
    student: StudentConfig,
    config: BakeConfig,
    session: Session,
    *,
    teacher: TeacherAvatar | None,
) -> tuple[Student, Progress]:
    """Train a student's field, codes and attributes on a teacher, or on photographs without one.

    Args:
        sequence: of the training frames.
        gaussians: from which the student starts, bound to the template.
        student: its architecture.
        config: of the bake.
        session: of the training; a stopped one continues from its checkpoint.
        teacher: frozen; None: photographs alone.

    Returns:
        The student and the progress of the last training that ran.
    """
    together = session.distributed or Distributed()
    with fixed_seed(config.seed):
        made = Student(student, sequence.rig, gaussians, sequence.train_frames)
    # Pretrain the field without rendering, and fit the regression to it.
    if config.pretrain is not None and teacher is not None and made.field is not None:
        pretrain = config.pretrain
        progress = session.within(PRETRAIN).run_alone(
            lambda: PretrainFieldTask(
                sequence,
                made,
                teacher,
                pretrain,
                config.seed,
                code_lr_factor=config.code_lr_factor,
                null_share=0.0 if config.regression else config.null_share,
            ),
            pretrain,
        )
        if not progress.finished:
            return made.eval(), progress
        session = session.after(progress)
        if config.regression:
            made.regression = _regressed(made, sequence, together)
        elif config.null_share:
            show_null_code(made)  # also on the processes that waited for the pretraining
    # Train on images, then fit the regression to the trained field.
    tracked = teacher.track if config.surface_normals and teacher is not None else None
    context = with_surface_normals(session.context, sequence, tracked)
    progress = session.run(lambda: BakeTask(sequence, made, config, context, teacher=teacher), config)
    if config.regression and made.field is not None:
        made.regression = _regressed(made, sequence, together)
    return made.eval(), progress


def _regressed(student: Student, sequence: AvatarSequence, together: Distributed) -> PoseRegression:
    """Return the regression that the first process fits, on each process's own device."""
    found = together.run_on_rank0(lambda: dict(regress_poses(student, sequence).named_buffers()))
    return PoseRegression(**found).to(student.rig.device)
