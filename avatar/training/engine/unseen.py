"""Gaussians that no training photograph shows keep their attributes, and skin under clothes gets the skin's colour."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from weakref import WeakKeyDictionary

import igl
import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree
from torch import Tensor, nn

from avatar.data.sequence import FrameSequence
from avatar.models.learned_gaussians import LEARNED, LearnedGaussians
from avatar.models.networks.blend_shapes import BlendShapes
from avatar.models.student import Student
from avatar.rendering.avatar_view import render_view
from smplxpp.core import Camera
from smplxpp.core.spread import spread_inside
from smplxpp.raster import rasterize_mesh
from smplxpp.template.mouth import inside_of_mouth, shown_mouth
from smplxpp.template.template import Template

# Results by template and by what is looked at, because all stages of a training need the same, which takes seconds, and
# some read the frames by a sequence of their own.
_FACES: WeakKeyDictionary[Template, dict[bytes, Bool[np.ndarray, " F"]]] = WeakKeyDictionary()


def unseen(sequence: FrameSequence, gaussians: LearnedGaussians) -> Bool[Tensor, " N"]:
    """Mark Gaussians inside a mouth that stays shut, and on clothes that are hidden in all views (an armpit)."""
    most_frames, most_views, most_cameras = 12, 600, 12  # more views would cost seconds and uncover little
    rig, frames = sequence.rig, sequence.train_frames
    cameras = [sequence.camera(name) for name in spread_inside(sequence.train_cameras, most_cameras)]
    # Posed by skinning alone: of the mouth, of clothes, by frame.
    ahead, around = spread_inside(frames, most_frames), spread_inside(frames, most_views // max(1, len(cameras)))
    places = {frame: rig.skin_to_numpy(sequence.pose(frame).without_cloth()) for frame in sorted({*ahead, *around})}
    sizes = [(one.width, one.height, one.orthographic) for one in cameras]
    digest = hashlib.sha256(repr((ahead, around, sizes)).encode())
    for array in (*places.values(), *(matrix for one in cameras for matrix in (one.K, one.cam_from_world))):
        digest.update(array.tobytes())
    known = _FACES.setdefault(rig.template, {})
    if digest.digest() not in known:
        clothes = _hidden_clothes(rig.template, [places[frame] for frame in around], cameras)
        mouth = _faces_of_shut_mouth(rig.template, [places[frame] for frame in ahead])
        known[digest.digest()] = mouth | clothes[rig.template.faces].all(axis=1)
    return torch.tensor(known[digest.digest()], device=gaussians.face_index.device)[gaussians.face_index]


def _faces_of_shut_mouth(template: Template, posed: list[Float64[np.ndarray, "V 3"]]) -> Bool[np.ndarray, " F"]:
    """Return the faces inside the mouth that are hidden from the front of the head in all poses."""
    inside = inside_of_mouth(template)
    shown = np.zeros_like(inside)
    if inside.any():
        # A vertex that any of the frames shows is trained by its photographs.
        for places in posed:
            shown |= shown_mouth(template, inside, places)
    return np.asarray(inside[template.faces].all(axis=1) & ~shown[template.faces].any(axis=1))


def _hidden_clothes(
    template: Template, posed: list[Float64[np.ndarray, "V 3"]], cameras: list[Camera]
) -> Bool[np.ndarray, " V"]:
    """Return the vertices of clothes that are hidden in all views of all poses.

    Skin is left out, because swinging cloth uncovers more of it than skinning shows.
    """
    tolerance = 0.01  # metres that a visible vertex may lie behind the z-buffer
    hidden = template.vertex_part > 0
    for places in posed:
        mesh = template.mesh.with_vertices(places)
        for camera in cameras:
            # Project the vertices that no view has shown yet, and compare their depths with the z-buffer.
            todo = np.flatnonzero(hidden)
            if not len(todo):
                return hidden
            x, y, depth = camera.screen_from_world(places[todo]).T[:3]
            inside = (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
            # The farthest depth among a pixel's neighbours, which errs on the side of visible. A background pixel is
            # infinitely far, so that silhouettes count as visible too.
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


@torch.no_grad()
def color_clothed_skin(sequence: FrameSequence, model: Student) -> Bool[Tensor, " N"]:
    """Give skin under clothes the colour of bare skin nearby, and return which Gaussians these are.

    They learn the colours of the clothes, with which they fill gaps between the clothes' own Gaussians; in a player
    that takes clothes off the body would wear their smear. Under clothes is skin with clothes within 3 cm before it,
    and skin of which the clothes leave less than 0.3 of what the training views would show of the body alone. The
    training that follows closes the gaps, if it holds these colours (`hold_colors`).

    Args:
        sequence: of the training frames.
        model: with the template's Gaussians; its colours are changed.
    """
    near, least_shown = 0.03, 0.3  # metres; share
    # Metres about clothes where bare skin may have their colours, as far as poses are exact.
    run_in = 0.015
    blended, power = 256, 3.0  # places whose colours are weighed by distance ^ -power: so many show no borders
    rig, gaussians = sequence.rig, model.gaussians
    template, face = rig.template, gaussians.face_index.cpu().numpy()
    corners = template.faces[face]
    outer = template.vertex_part == 0
    outer[: template.body.vertex_count] &= template.body.outer_skin
    skin = outer[corners].all(axis=1) & ~inside_of_mouth(template)[corners].any(axis=1)
    worn = template.vertex_part[template.faces[:, 0]] > 0
    hidden = np.zeros(len(face), dtype=bool)
    if not skin.any() or not worn.any():
        return torch.tensor(hidden, device=gaussians.face_index.device)
    # Clothes before the skin at rest: the nearest point of them lies outwards.
    places = template.vertices[corners].mean(axis=1)
    tree = igl.AABB()
    tree.init(template.vertices, template.faces[worn])
    squared, _, at = tree.squared_distance(template.vertices, template.faces[worn], places)
    away = np.sqrt(np.asarray(squared).reshape(-1))
    outwards = np.einsum("nd,nd->n", at - places, template.mesh.face_normals[face]) > 0.3 * away
    shown, alone = _blending_weights(sequence, model, skin)
    hidden = skin & ((outwards & (away < near)) | ((alone > 0.0) & (shown < least_shown * alone)))
    known, rows = np.flatnonzero(skin & ~hidden), np.flatnonzero(hidden)
    if len(known) and len(rows):
        clear = cKDTree(places[rows]).query(places[known])[0] > run_in
        known = known[clear] if clear.any() else known
        apart, nearest = cKDTree(places[known]).query(places[rows], k=range(1, min(blended, len(known)) + 1))
        weight = np.maximum(apart, 1e-4)[..., None] ** -power
        colors = gaussians.dc.cpu().numpy()[known[nearest]]
        mean = (weight * colors).sum(axis=1) / weight.sum(axis=1)
        gaussians.dc[rows] = torch.tensor(mean).to(gaussians.dc)
        gaussians.sh[rows] = 0.0
    return torch.tensor(hidden, device=gaussians.face_index.device)


def _blending_weights(
    sequence: FrameSequence, model: Student, skin: Bool[np.ndarray, " N"]
) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
    """Return the sums over up to 72 training views of each Gaussian's weight in the pixels, and that of skin alone."""
    most_frames, most_cameras = 6, 12
    shown, alone = np.zeros(len(skin)), np.zeros(len(skin))
    opaque = torch.tensor(skin, device=model.gaussians.dc.device)
    for frame in spread_inside(sequence.train_frames, most_frames):
        for camera in spread_inside(sequence.train_cameras, most_cameras):
            view = sequence.view(camera, frame)
            posed = model(sequence.pose(frame), view.position[None])
            world = posed.gaussians
            naked = replace(world, opacities=torch.where(opaque, world.opacities, torch.zeros_like(world.opacities)))
            for total, gaussians in ((shown, world), (alone, naked)):
                # The derivative of the sum of a picture by the Gaussians' values is their weight in it.
                with torch.enable_grad():
                    value = torch.ones_like(world.means[:, :1]).requires_grad_()
                    drawn = render_view(replace(posed, gaussians=gaussians), 0, view, sequence.background, extra=value)
                    assert drawn.extra is not None
                    (weight,) = torch.autograd.grad(drawn.extra.sum(), value)
                total += weight[:, 0].double().cpu().numpy()
    return shown, alone


def hold_colors(gaussians: LearnedGaussians, shapes: BlendShapes | None, held: Bool[Tensor, " N"]) -> None:
    """Clear the gradients of the colours of some Gaussians, blend shapes included; they may move and grow."""
    rows = held.nonzero()[:, 0]
    for learned in (gaussians.dc, gaussians.sh):
        _clear_gradients(learned, rows)
    if shapes is not None:
        _clear_gradients(shapes.C, held[shapes.active].nonzero()[:, 0])


def _clear_gradients(parameter: nn.Parameter, rows: Int64[Tensor, " K"]) -> None:
    """Clear rows of a gradient after each backward pass, in place: a mask would rewrite the whole gradient."""

    def clear(learned: Tensor) -> None:
        if learned.grad is not None:
            learned.grad.index_fill_(0, rows, 0.0)

    if parameter.requires_grad and parameter.numel():
        parameter.register_post_accumulate_grad_hook(clear)
