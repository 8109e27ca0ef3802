"""Prune a trained student to a number of bytes: only the most active Gaussians keep their blend shapes."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from avatar.data.sequence import AvatarSequence
from avatar.models.networks.blend_shapes import STORED_BYTES
from avatar.models.student import Student
from smplxpp.core.errors import InputError


def coefficient_std(student: Student, sequence: AvatarSequence) -> Float[Tensor, "parts n"]:
    """Return the standard deviations of the blend shapes' coefficients over the training frames.

    Args:
        student: with blend shapes.
        sequence: of the training frames.
    """
    shapes = student.blend_shapes
    assert shapes is not None, "a student with blend shapes"
    rows = []
    with torch.no_grad():
        for frame in sequence.train_frames:
            # The coefficients (P, n) of each frame, as the player computes them.
            pose = sequence.pose(frame)
            jaw = pose.jaw[None] if shapes.config.jaw else None
            rows.append(shapes.coefficients(pose.expression[None], pose.body_pose[None], jaw)[0])
    found = torch.stack(rows).std(dim=0, correction=0)
    # Shapes of motions that training did not show are held ready for them, and count as the strongest others do.
    return torch.where(found == 0.0, found.max(), found)


def pruned_to(student: Student, sequence: AvatarSequence, max_bytes: float) -> tuple[Student, float]:
    """Return the student with as many Gaussians' blend shapes as fit into a compact file of `max_bytes`.

    Gaussians whose position and colour vary most over the training frames keep theirs (`BlendShapes.pruned`).

    Args:
        student: with blend shapes.
        sequence: of the training frames.
        max_bytes: of the compact file.

    Returns:
        The pruned student and the share of Gaussians that keep their blend shapes; the student itself and 1 if all fit.

    Raises:
        InputError: the Gaussians and networks alone are larger.
    """
    shapes = student.blend_shapes
    assert shapes is not None, "a student with blend shapes"
    # Bytes of everything but the blend shapes, and of one Gaussian's blend shapes.
    count, stored = shapes.count, student.state_dict()
    one = 2 * 3 * shapes.config.shapes * STORED_BYTES + 4  # U, C and the Gaussian's index in `active`
    tensors = {
        name: value
        for name, value in stored.items()
        if name not in ("blend_shapes.U", "blend_shapes.C", "blend_shapes.active")
    }
    header_bytes = 16_384  # more than names and shapes of a model file take
    rest = header_bytes + sum(value.numel() * _compact_size(value) for value in tensors.values())
    # Share of the Gaussians whose blend shapes fit.
    keep = min(1.0, (max_bytes - rest) / (one * count))
    if keep * count < 1:
        raise InputError(
            "size of the compact student",
            expected=f"room for {rest / 1e6:.1f} MB of Gaussians and networks",
            received=f"{max_bytes / 1e6:.1f} MB",
            remedy="allow more, or train with fewer Gaussians",
        )
    if keep == 1.0:
        return student, 1.0
    # Round down to whole Gaussians, so that the file is never larger than allowed.
    keep = math.floor(keep * count) / count
    return student.with_blend_shapes(shapes.pruned(coefficient_std(student, sequence), keep=keep)).eval(), keep


def _compact_size(value: Tensor) -> int:
    """Return the bytes of a number in a compact model file."""
    return STORED_BYTES if value.is_floating_point() else min(4, value.element_size())
