"""What no photograph of the training shows keeps the colours and places that it starts with."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Bool, Int64
from scipy.ndimage import maximum_filter
from torch import Tensor, nn

from avatar.data.sequence import FrameSequence
from avatar.models.learned_gaussians import LEARNED, LearnedGaussians
from avatar.models.networks.blend_shapes import BlendShapes
from smplxpp.core.spread import spread_inside
from smplxpp.raster import rasterize_mesh
from smplxpp.template.mouth import inside_of_mouth, shown_mouth

LOOKED_INTO = 12
"""Frames of the training, at most, whose mouths are looked into."""
LOOKED_AT = 600
"""Views of the training, at most, in which clothes are looked for."""
CAMERAS = 12
"""Of these, cameras at most."""
TOLERANCE = 0.01
"""Metres that clothes may lie behind what a camera sees and still count as seen."""
# Of the sequences that are still there: all stages of a training ask for the same, which takes seconds.
_FOUND: WeakKeyDictionary[FrameSequence, Bool[np.ndarray, " F"]] = WeakKeyDictionary()


def unseen(sequence: FrameSequence, gaussians: LearnedGaussians) -> Bool[Tensor, " N"]:
    """Mark the Gaussians inside a mouth that stays shut, and on clothes that hide in all views, as in an armpit."""
    if sequence not in _FOUND:
        clothes = _hidden_clothes(sequence)[sequence.rig.template.faces].all(axis=1)
        _FOUND[sequence] = _faces_of_shut_mouth(sequence) | clothes
    return torch.tensor(_FOUND[sequence], device=gaussians.face_index.device)[gaussians.face_index]


def _faces_of_shut_mouth(sequence: FrameSequence) -> Bool[np.ndarray, " F"]:
    """The faces inside the mouth that nobody ahead of the head sees in any frame looked at."""
    rig = sequence.rig
    inside = inside_of_mouth(rig.template)
    shown = np.zeros_like(inside)
    if inside.any():
        for frame in spread_inside(sequence.train_frames, LOOKED_INTO):
            shown |= shown_mouth(rig.template, inside, rig.skin_to_numpy(sequence.pose(frame).without_cloth()))
    faces = rig.template.faces
    return np.asarray(inside[faces].all(axis=1) & ~shown[faces].any(axis=1))


def _hidden_clothes(sequence: FrameSequence) -> Bool[np.ndarray, " V"]:
    """The vertices of the parts, which follow the joints here, that something hides in every view looked at.

    The skin is not judged: cloth that swings shows more of it than joints tell.
    """
    rig = sequence.rig
    hidden = rig.template.vertex_part > 0
    cameras = [sequence.camera(name) for name in spread_inside(sequence.train_cameras, CAMERAS)]
    for frame in spread_inside(sequence.train_frames, LOOKED_AT // max(1, len(cameras))):
        places = rig.skin_to_numpy(sequence.pose(frame).without_cloth())
        mesh = rig.template.mesh.with_vertices(places)
        for camera in cameras:
            todo = np.flatnonzero(hidden)
            if not len(todo):
                return hidden
            x, y, depth = camera.screen_from_world(places[todo]).T[:3]
            inside = (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
            front = maximum_filter(rasterize_mesh(mesh, camera).depth, 3)
            before = np.full(len(todo), -np.inf)
            before[inside] = front[y[inside].astype(int), x[inside].astype(int)]
            hidden[todo[depth <= before + TOLERANCE]] = False
    return hidden


def hold_unseen(sequence: FrameSequence, gaussians: LearnedGaussians, shapes: BlendShapes | None) -> None:
    """Let no gradient reach what `unseen` marks: attributes and blend shapes of these Gaussians.

    Behind what hides them gradients are tiny, and Adam takes full steps along them: teeth would drift to the colours of
    lips, cloth in an armpit to those of the arm, and into places where another pose shows them.
    """
    learned = [getattr(gaussians, name) for name in LEARNED] + ([] if shapes is None else [shapes.U, shapes.C])
    if not any(one.requires_grad for one in learned):
        return
    hidden = unseen(sequence, gaussians)
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
