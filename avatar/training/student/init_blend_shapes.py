"""Initialise blend shapes by PCA: the residual between the tracked surface and the field's."""

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
    optimiser = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=weight_decay)
    # Fresh noise on theta in each step: the fit is a smooth function about each pose, not a value at it alone.
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    noise = torch.Generator().manual_seed(0)
    for _ in range(steps):
        blurred = pose + pose_noise * torch.randn(pose.shape, generator=noise).to(pose)
        found = network(blurred).unflatten(1, targets.shape[1:])
        loss = ((found - targets) * weight).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
