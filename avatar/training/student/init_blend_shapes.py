"""Blend shapes that start from what the field left over of a surface that was followed."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.sequence import AvatarSequence
from avatar.gaussians.binding import on_triangles
from avatar.gaussians.frames import triangle_frames
from avatar.models.networks.blend_shapes import BlendShapes
from avatar.models.student import Student
from avatar.models.tracked_surface import Track
from smplxpp.core.spread import spread_inside

FRAMES = 256
"""At most as many, spread over the training's, are looked at."""
STEPS, RATE, POSE_NOISE, WEIGHT_DECAY = 600, 3e-3, 0.03, 1e-3
"""Of the regression from poses to coefficients: Adam's steps and rate, radians, share of the weights."""


def init_blend_shapes(student: Student, sequence: AvatarSequence, track: Track) -> None:
    """Set U's columns of the body and the network that drives them; C and the head's columns stay.

    With `r_t = R^T (dv_track - dv_field)` at the Gaussians in frame t, `U z_t` are the first principal components of
    r, coefficients of unit deviation, and `B(theta_t)` is fitted to them by least squares. Poses are blurred a little,
    so that B stays smooth between the few that there are.
    """
    shapes, rig = student.blend_shapes, sequence.rig
    assert shapes is not None, "a student with blend shapes"
    bound = student.gaussians()
    local = triangle_frames(rig.vertices, rig.faces).rotations[bound.face_index]
    residuals, poses = [], []
    with torch.no_grad():
        for frame in spread_inside(sequence.train_frames, FRAMES):
            pose = sequence.pose(frame)
            left = track.displacements(frame)
            moved = student.displacements(pose)
            if moved is not None:
                left = left - moved
            at_gaussians = on_triangles(left[rig.faces[bound.face_index]], bound.barycentric)
            residuals.append(torch.einsum("nij,ni->nj", local, at_gaussians)[shapes.active])
            poses.append(pose.body_pose)
        r, body_poses = torch.stack(residuals), torch.stack(poses)
        targets = _components(shapes, r)
    _fit(shapes, body_poses, targets)


def _components(shapes: BlendShapes, residuals: Float[Tensor, "T M 3"]) -> Float[Tensor, "T parts n_b"]:
    """Set U from residuals in metres; return the coefficients."""
    head, body, frames = shapes.config.head_shapes, shapes.config.body_shapes, len(residuals)
    count = min(body, frames)
    out = residuals.new_zeros(frames, shapes.config.parts, body)
    of_part = None if shapes.part is None else shapes.part[shapes.active]
    for part in range(shapes.config.parts):
        rows = slice(None) if of_part is None else torch.nonzero(of_part == part)[:, 0]
        own = residuals[:, rows]
        if shapes.head_weight is not None:
            # Columns of the body do nothing where the head's act.
            own = own * (1.0 - shapes.head_weight[shapes.active][rows, None])
        own = own.flatten(1).double()
        # T is small beside 3 M: the eigenvectors of the frames' products are the coefficients.
        _, vectors = torch.linalg.eigh(own @ own.T)
        vectors = vectors[:, -count:].flip(1) * frames**0.5
        basis = own.T @ vectors / frames
        shapes.U[rows, :, head : head + count] = basis.view(-1, 3, count).to(shapes.U.dtype)
        out[:, part, :count] = vectors.to(out.dtype)
    return out


def _fit(shapes: BlendShapes, pose: Float[Tensor, "T 63"], targets: Float[Tensor, "T parts n_b"]) -> None:
    """Bring B(theta) to the coefficients."""
    network = shapes.body
    # Coefficients count as much as the motion that they stand for.
    size = shapes.U.detach()[..., shapes.config.head_shapes :].square().sum((0, 1)).sqrt()
    weight = size / size.max().clamp(min=1e-12)
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    noise = torch.Generator().manual_seed(0)
    for _ in range(STEPS):
        blurred = pose + POSE_NOISE * torch.randn(pose.shape, generator=noise).to(pose)
        found = network(blurred).unflatten(1, targets.shape[1:])
        loss = ((found - targets) * weight).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
