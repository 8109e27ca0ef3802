"""The inside of a mouth that training never sees open keeps the colours that it starts with."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor, nn

from avatar.data.sequence import FrameSequence
from avatar.models.learned_gaussians import LEARNED, LearnedGaussians
from avatar.models.networks.blend_shapes import BlendShapes
from smplxpp.core.spread import spread_inside
from smplxpp.template.mouth import inside_of_mouth, shown_mouth

LOOKED_AT = 12
"""Frames of the training, at most, whose mouths are looked into."""


def unseen_mouth(sequence: FrameSequence, gaussians: LearnedGaussians) -> Bool[Tensor, " N"]:
    """Mark the Gaussians inside the mouth whose triangle nobody ahead of the head sees in any frame looked at."""
    rig = sequence.rig
    inside = inside_of_mouth(rig.template)
    shown = np.zeros_like(inside)
    if inside.any():
        for frame in spread_inside(sequence.train_frames, LOOKED_AT):
            shown |= shown_mouth(rig.template, inside, rig.places(sequence.motion(frame).without_cloth()))
    faces = rig.template.faces
    hidden = torch.tensor(inside[faces].all(axis=1) & ~shown[faces].any(axis=1), device=gaussians.face_index.device)
    return hidden[gaussians.face_index]


def hold_unseen_mouth(sequence: FrameSequence, gaussians: LearnedGaussians, shapes: BlendShapes | None) -> None:
    """Let no gradient reach what `unseen_mouth` marks: attributes and blend shapes of these Gaussians.

    Behind closed lips gradients are tiny, and Adam takes full steps along them: teeth would drift to the colours of
    lips and into places where an open mouth shows them.
    """
    hidden = unseen_mouth(sequence, gaussians)
    if not bool(hidden.any()):
        return
    held = hidden.nonzero()[:, 0]
    for name in LEARNED:
        _hold(getattr(gaussians, name), held)
    if shapes is not None:
        held = hidden[shapes.active].nonzero()[:, 0]
        for basis in (shapes.U, shapes.C):
            _hold(basis, held)


def _hold(parameter: nn.Parameter, held: Int64[Tensor, " K"]) -> None:
    """Clear these rows of a gradient when it is there: a product with a mask would write all of it once more."""

    def clear(learned: Tensor) -> None:
        if learned.grad is not None:
            learned.grad.index_fill_(0, held, 0.0)

    if parameter.requires_grad and parameter.numel():
        parameter.register_post_accumulate_grad_hook(clear)
