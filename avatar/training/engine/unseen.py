"""Gaussians that no training photograph shows keep their initial attributes: their gradients are cleared."""

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

# Results by sequence, because all stages of a training need the same, which takes seconds.
_FACES: WeakKeyDictionary[FrameSequence, Bool[np.ndarray, " F"]] = WeakKeyDictionary()


def unseen(sequence: FrameSequence, gaussians: LearnedGaussians) -> Bool[Tensor, " N"]:
    """Mark Gaussians inside a mouth that stays shut, and on clothes that are hidden in all views (an armpit)."""
    if sequence not in _FACES:
        clothes = _hidden_clothes(sequence)[sequence.rig.template.faces].all(axis=1)
        _FACES[sequence] = _faces_of_shut_mouth(sequence) | clothes
    return torch.tensor(_FACES[sequence], device=gaussians.face_index.device)[gaussians.face_index]


def _faces_of_shut_mouth(sequence: FrameSequence) -> Bool[np.ndarray, " F"]:
    """Return the faces inside the mouth that are hidden from the front of the head in up to 12 training frames."""
    most_frames = 12
    rig = sequence.rig
    inside = inside_of_mouth(rig.template)
    shown = np.zeros_like(inside)
    if inside.any():
        # A vertex that any of the frames shows is trained by its photographs.
        for frame in spread_inside(sequence.train_frames, most_frames):
            shown |= shown_mouth(rig.template, inside, rig.skin_to_numpy(sequence.pose(frame).without_cloth()))
    faces = rig.template.faces
    return np.asarray(inside[faces].all(axis=1) & ~shown[faces].any(axis=1))


def _hidden_clothes(sequence: FrameSequence) -> Bool[np.ndarray, " V"]:
    """Return the vertices of clothes, posed by skinning alone, that are hidden in all of up to 600 training views.

    Skin is left out, because swinging cloth uncovers more of it than skinning shows.
    """
    most_views, most_cameras = 600, 12  # more views would cost seconds and uncover little
    tolerance = 0.01  # metres that a visible vertex may lie behind the z-buffer
    rig = sequence.rig
    hidden = rig.template.vertex_part > 0
    cameras = [sequence.camera(name) for name in spread_inside(sequence.train_cameras, most_cameras)]
    for frame in spread_inside(sequence.train_frames, most_views // max(1, len(cameras))):
        places = rig.skin_to_numpy(sequence.pose(frame).without_cloth())
        mesh = rig.template.mesh.with_vertices(places)
        for camera in cameras:
            # Project the vertices that no view has shown yet, and compare their depths with the z-buffer.
            todo = np.flatnonzero(hidden)
            if not len(todo):
                return hidden
            x, y, depth = camera.screen_from_world(places[todo]).T[:3]
            inside = (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
            # The farthest depth among a pixel's neighbours, which errs on the side of visible. A background pixel is
            # infinitely
            # far, so that silhouettes count as visible too.
            front = maximum_filter(rasterize_mesh(mesh, camera).depth, 3)
            before = np.full(len(todo), -np.inf)
            before[inside] = front[y[inside].astype(int), x[inside].astype(int)]
            hidden[todo[depth <= before + tolerance]] = False
    return hidden


def hold_unseen(sequence: FrameSequence, gaussians: LearnedGaussians, shapes: BlendShapes | None) -> None:
    """Clear the gradients of attributes and blend shapes of the Gaussians that `unseen` marks.

    Gradients of hidden Gaussians are tiny, but Adam takes full steps along them: teeth would drift to the colours of
    lips, cloth in an armpit to those of the arm, and to positions where another pose shows them.

    Args:
        sequence: of the training frames.
        gaussians: whose attributes learn.
        shapes: whose bases learn; None: none.
    """
    learned = [getattr(gaussians, name) for name in LEARNED] + ([] if shapes is None else [shapes.U, shapes.C])
    if not any(one.requires_grad for one in learned):
        return
    hidden = unseen(sequence, gaussians)
    if not bool(hidden.any()):
        return
    rows = hidden.nonzero()[:, 0]
    for name in LEARNED:
        _clear_gradients(getattr(gaussians, name), rows)
    if shapes is not None:
        rows = hidden[shapes.active].nonzero()[:, 0]
        for basis in (shapes.U, shapes.C):
            _clear_gradients(basis, rows)


def _clear_gradients(parameter: nn.Parameter, rows: Int64[Tensor, " K"]) -> None:
    """Clear rows of a gradient after each backward pass, in place: a mask would rewrite the whole gradient."""

    def clear(learned: Tensor) -> None:
        if learned.grad is not None:
            learned.grad.index_fill_(0, rows, 0.0)

    if parameter.requires_grad and parameter.numel():
        parameter.register_post_accumulate_grad_hook(clear)
