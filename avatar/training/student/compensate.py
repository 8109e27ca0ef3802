"""The compensation: blend shapes of the Gaussians learn the residual of the baked mesh; the field is frozen."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from avatar.data.sequence import AvatarSequence, Item, camera_centers_of
from avatar.gaussians.binding import on_triangles
from avatar.gaussians.frames import triangle_frames
from avatar.losses.deformation import Coherence
from avatar.models.model_file import load_avatar, save_avatar
from avatar.models.networks.blend_shapes import BlendShapeConfig, BlendShapes
from avatar.models.student import Student
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked_surface import Track
from avatar.training.engine.adam import Adam, ParameterGroup, pixel_size
from avatar.training.engine.loop import Progress
from avatar.training.engine.photometric_task import (
    ALONE,
    PhotometricConfig,
    PhotometricTask,
    TaskContext,
    with_surface_normals,
)
from avatar.training.engine.resources import fixed_seed
from avatar.training.engine.session import Session
from avatar.training.engine.unseen import color_clothed_skin, hold_colors
from avatar.training.student.bake import new_pose_as_seen
from avatar.training.student.prune import pruned_to
from avatar.training.student.unseen_motion import on_drawn_face, with_held_face
from smplxpp.core import InputError, require_at_least, require_between
from smplxpp.core.spread import spread_inside

FRAMES = 256
"""Largest number of training frames, evenly spread, which bounds the memory of the residuals."""


def init_blend_shapes(student: Student, sequence: AvatarSequence, track: Track) -> None:
    """Set U's columns of the body and the network B that drives them; C and the head's columns stay.

    With the residuals `r_t = R^T (dv_track - dv_field)` at the Gaussians in frame t, `U z_t` are the first principal
    components of r, with coefficients z of unit deviation. `B(theta_t)` is fitted to z_t by least squares on poses with
    a little noise, so that B is smooth between them.

    Args:
        student: with blend shapes.
        sequence: of the training frames.
        track: the tracked surface.
    """
    shapes, rig = student.blend_shapes, sequence.rig
    assert shapes is not None, "a student with blend shapes"
    bound = student.gaussians()
    # Rotations of the triangles in the T-pose: blend shapes are in the triangles' frames.
    local = triangle_frames(rig.vertices, rig.faces).rotations[bound.face_index]
    residuals, poses = [], []
    with torch.no_grad():
        for frame in spread_inside(sequence.train_frames, FRAMES):
            # Displacement that the field leaves over, in the triangles' frames of the T-pose.
            pose = sequence.pose(frame)
            left = track.displacements(frame)
            moved = student.displacements(pose)
            if moved is not None:
                left = left - moved
            at_gaussians = on_triangles(left[rig.faces[bound.face_index]], bound.barycentric)
            # R^T times the residual at each Gaussian that has blend shapes, metres.
            residuals.append(torch.einsum("nij,ni->nj", local, at_gaussians)[shapes.active])
            poses.append(pose.body_pose)
        # Principal components of the residuals, and their coefficients as targets of B.
        r, body_poses = torch.stack(residuals), torch.stack(poses)
        targets = _components(shapes, r)
    _fit(shapes, body_poses, targets)


def _components(shapes: BlendShapes, residuals: Float[Tensor, "T M 3"]) -> Float[Tensor, "T parts n_b"]:
    """Set U to the principal components of residuals in metres, part by part, and return their coefficients."""
    head, body, frames = shapes.config.head_shapes, shapes.config.body_shapes, len(residuals)
    count = min(body, frames)
    out = residuals.new_zeros(frames, shapes.config.parts, body)
    of_part = None if shapes.part is None else shapes.part[shapes.active]
    for part in range(shapes.config.parts):
        rows = slice(None) if of_part is None else torch.nonzero(of_part == part)[:, 0]
        own = residuals[:, rows]
        if shapes.head_weight is not None:
            # The body's columns have no effect where the head's have all of it.
            own = own * (1.0 - shapes.head_weight[shapes.active][rows, None])
        own = own.flatten(1).double()
        # T is small beside 3 M, so that the Gram matrix of the frames is decomposed: its eigenvectors are coefficients.
        _, vectors = torch.linalg.eigh(own @ own.T)
        # The largest eigenvalues come last. Coefficients of T frames with mean square 1 have the length sqrt(T), and
        # the
        # basis is then the mean of r z.
        vectors = vectors[:, -count:].flip(1) * frames**0.5
        basis = own.T @ vectors / frames
        shapes.U[rows, :, head : head + count] = basis.view(-1, 3, count).to(shapes.U.dtype)
        out[:, part, :count] = vectors.to(out.dtype)
    return out


def _fit(
    shapes: BlendShapes, pose: Float[Tensor, "T 63"], targets: Float[Tensor, "T parts n_b"], *, steps: int = 600
) -> None:
    """Fit B(theta) to the coefficients by AdamW on poses with noise, in quick steps that render nothing."""
    rate, pose_noise, weight_decay = 3e-3, 0.03, 1e-3  # noise in radians
    network = shapes.body
    # The weight of a coefficient's error is the norm of its blend shape.
    size = shapes.U.detach()[..., shapes.config.head_shapes :].square().sum((0, 1)).sqrt()
    weight = size / size.max().clamp(min=1e-12)
    learned: dict[str, Any] = {"params": list(network.parameters())}
    optimiser = Adam([learned], weight_decay=weight_decay)
    # Fresh noise on theta in each step: the fit is a smooth function about each pose, not a value at it alone.
    noise = torch.Generator().manual_seed(0)
    for step in range(steps):
        learned["lr"] = rate * 0.5 * (1.0 + math.cos(math.pi * step / steps))
        blurred = pose + pose_noise * torch.randn(pose.shape, generator=noise).to(pose)
        found = network(blurred).unflatten(1, targets.shape[1:])
        loss = ((found - targets) * weight).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


@dataclass(frozen=True, kw_only=True)
class CompensateConfig(PhotometricConfig):
    """Choices of the compensation: rates, coherence, initialisation.

    Attributes:
        iterations: 100k in the paper.
        poses_per_step: 4 in the paper.
        lr: learning rate of the mapping networks.
        position_lr: learning rate of U, pixels.
        color_lr: learning rate of C, colours in [0, 1].
        null_share: share of the poses that are shown as new ones.
        init_from_track: initialise the blend shapes by the residual between the teacher's tracked surface and the field
            (`init_blend_shapes`); False: zero, as in the paper.
        coherence: weight of the differences between neighbours' changes of U (`Coherence`); 0, as in the paper: none.
    """

    iterations: int = 100_000
    poses_per_step: int = 4
    position_lr: float = 0.02
    color_lr: float = 1e-3
    null_share: float = 0.0
    init_from_track: bool = False
    coherence: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_between("compensation: null_share", self.null_share, 0.0, 1.0)
        require_at_least("compensation: coherence", self.coherence, 0.0)


class CompensateTask(PhotometricTask):
    """Trains U, C and the mapping networks H and B on photographs by `L_rec`; field and codes are frozen.

    With `coherence`, neighbours' changes of U since the start of the task are held together.

    Args:
        sequence: of the training frames.
        student: with blend shapes.
        config: of the compensation.
        context: perceptual distance, processes, previews.
        held: Gaussians that keep their colours.

    Raises:
        InputError: a student without blend shapes.
    """

    config: CompensateConfig
    sequence: AvatarSequence

    def __init__(
        self,
        sequence: AvatarSequence,
        student: Student,
        config: CompensateConfig,
        context: TaskContext = ALONE,
        *,
        held: Bool[Tensor, " N"] | None = None,
    ) -> None:
        shapes = student.blend_shapes
        if shapes is None:
            raise InputError("student of the compensation", expected="blend shapes", received="none")
        # Freeze the field and the codes.
        for frozen in (student.field, student.codes):
            if frozen is not None:
                frozen.requires_grad_(False)
        # Parameters: mapping networks, U in pixels, C in colours.
        mapping = {f"head.{name}": value for name, value in shapes.head.named_parameters()}
        mapping |= {f"body.{name}": value for name, value in shapes.body.named_parameters()}
        groups = [
            ParameterGroup("mapping", mapping, config.lr, config.lr_final_factor),
            ParameterGroup(
                "positions", {"U": shapes.U}, config.position_lr * pixel_size(sequence), config.lr_final_factor
            ),
            ParameterGroup("colors", {"C": shapes.C}, config.color_lr, config.lr_final_factor),
        ]
        super().__init__(sequence, student, config, groups, context)
        self.student = student
        if held is not None:
            hold_colors(student.gaussians, shapes, held)
        # The coherence term is relative to the present U.
        self.shapes, self.coherence = shapes, None
        if config.coherence:
            self.coherence = Coherence(student.rig, student.gaussians().select(shapes.active), shapes.U)

    def loss(self, item: Item) -> tuple[Tensor, Mapping[str, Tensor]]:
        """Return `L_rec` and the weighted coherence of one frame, and the terms."""
        views = self.views(item)
        # A share of the poses is shown as new ones.
        pose = self.sequence.pose(item.frame)
        if self.config.null_share and self.generator(item.frame).random() < self.config.null_share:
            pose = new_pose_as_seen(self.student, self.sequence, item.frame)
        # L_rec on all views; the gradients reach the blend shapes, and the attributes by their own rates.
        posed = self.student(pose, camera_centers_of(views))
        total, terms, _ = self.compared(posed, views)
        if self.coherence is not None:
            # The coherence has its own random stream, so that it does not change which poses are shown as new.
            apart = self.coherence(self.shapes.U, self.generator(item.frame, 1))
            total = total + self.config.coherence * apart
            terms["coherence"] = apart.detach()
        return total, {"loss": total.detach(), **terms}


def compensate(
    sequence: AvatarSequence,
    student: Student,
    shapes: BlendShapeConfig,
    config: CompensateConfig,
    session: Session,
    *,
    teacher: TeacherAvatar | None = None,
) -> tuple[Student, Progress]:
    """Add blend shapes to a baked student and train them.

    Args:
        sequence: of the training frames.
        student: from the bake.
        shapes: architecture of the blend shapes.
        config: of the compensation.
        session: of the training; a stopped one continues from its checkpoint.
        teacher: of the bake. Its tracked surface, if any, initialises the blend shapes where `config` requests it, and
            gives normals where the capture has no maps.

    Returns:
        The student and the progress of its training.
    """
    with fixed_seed(config.seed):
        # Poses near which the body's shapes keep their full weight (`PoseGate`); initial values come from a fixed
        # seed.
        # One pose at a time, because each holds all vertices.
        shown = ((pose.body_pose, pose.expression, pose.jaw) for pose in map(sequence.pose, sequence.train_frames))
        known, expressions, jaws = (torch.stack(rows) for rows in zip(*shown, strict=True))
        student = on_drawn_face(student)
        made = student.with_blend_shapes(shapes, known_poses=known if config.null_share else None)
        made.fps = frame_rate(sequence)
        if config.init_from_track and teacher is not None and teacher.track is not None:
            init_blend_shapes(made, sequence, teacher.track)
    # Only where the Gaussians learn on: they close what the colours of skin leave open between the clothes' own.
    held = color_clothed_skin(sequence, made) if config.attributes else None
    tracked = teacher.track if config.surface_normals and teacher is not None else None
    context = with_surface_normals(session.context, sequence, tracked)
    progress = session.run(lambda: CompensateTask(sequence, made, config, context, held=held), config)
    # Gaussians have moved on since. New modules draw random numbers before they get their values.
    with fixed_seed(config.seed):
        return with_held_face(on_drawn_face(made), expressions, jaws).eval(), progress


def frame_rate(sequence: AvatarSequence) -> float | None:
    """Return the training frames a second, by the median step between them; None where the capture states no rate."""
    fps, steps = sequence.capture.fps, np.diff(sequence.train_frames)
    return None if fps is None else float(fps / max(np.median(steps), 1)) if len(steps) else fps


def write_student(
    whole: Path,
    compact: Path,
    student: Student,
    sequence: AvatarSequence,
    config: CompensateConfig,
    *,
    max_bytes: float | None,
    context: TaskContext,
) -> dict[str, Any]:
    """Write a student whole, and compact for players, and measure the compact one after reading it back.

    Args:
        whole: file of the student in single precision.
        compact: file of the student for players, in half precision.
        student: with blend shapes.
        sequence: the frames and views that it is measured on.
        config: of its training.
        max_bytes: bound of the compact file, which leaves out blend shapes to keep it; None: it has all.
        context: of its training.

    Returns:
        "bytes" of the files by name; "compact": the share of the blend shapes that it keeps, and its figures.
    """
    small, keep = (student, 1.0) if max_bytes is None else pruned_to(student, sequence, max_bytes)
    bytes_of = {whole.name: save_avatar(whole, student), compact.name: save_avatar(compact, small, compact=True)}
    # Read the file as a player does: half precision, pruned blend shapes.
    stored = load_avatar(compact, sequence.rig)
    assert isinstance(stored, Student)
    # Figures are those of the stored student on held-out views; the preview shows the training alone.
    quiet = replace(context, preview=lambda images: None)
    # Without the coherence term, whose search for neighbours only a training needs.
    task = CompensateTask(sequence, stored, replace(config, coherence=0.0), quiet)
    figures = task.evaluate(config.iterations)
    measured = {kind: figures[kind] for kind in ("novel_view", "novel_pose") if kind in figures}
    return {"bytes": bytes_of, "compact": {"kept_blend_shapes": keep, **measured}}
