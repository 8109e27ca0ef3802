"""Hold the face's Gaussians to their surface in motions that training never showed: closing lids, a hanging jaw.

Training lets Gaussians slide by a centimetre, so that one that draws an eye may move with a lid. The head's blend
shapes get a shape for each such motion. Its coefficient is 0 up to the strength that training showed, so that nothing
changes there, and 1 from some more on, where lids lie on their surface in the colour of the skin around the eye and
nothing hangs before an open mouth.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import igl
import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from torch import Tensor, nn

from avatar.gaussians.binding import BoundGaussians, on_triangles, world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.sampling import head_faces
from avatar.gaussians.tensor_operations import multiply_quats, quat_from_matrix
from avatar.models.learned_gaussians import LearnedGaussians
from avatar.models.networks.blend_shapes import BlendShapes
from avatar.models.student import Student
from smplxpp.core import BodyParams, Camera, TriangleMesh
from smplxpp.core.spherical_harmonics import rotate_sh
from smplxpp.raster import rasterize_mesh
from smplxpp.template.mouth import inside_of_mouth
from smplxpp.template.template import BODY_PART, Template

_JAW = 0.3  # radians of a jaw that hangs: where the mouth's shape is made
_JAW_OPEN = 0.35  # radians of the jaw that move lips as far as the expression jawOpen does


@dataclass(frozen=True, eq=False)
class UnseenMotion:
    """A motion of the face that goes beyond what training showed.

    Attributes:
        kind: "left", "right" (lids) or "jaw".
        weights: of the head's inputs (expression, then jaw), whose sum is the motion's strength.
        begin: strength up to which the trained appearance holds: the largest of training.
        end: strength from which the held one does.
    """

    kind: str
    weights: Float64[np.ndarray, " I"]
    begin: float
    end: float


@torch.no_grad()
def with_held_face(student: Student, expressions: Float[Tensor, "T E"], jaws: Float[Tensor, "T 3"]) -> Student:
    """Return the student with a blend shape of the head for each motion of lids and jaw that training did not show.

    Args:
        student: trained, with blend shapes; one without, or of a body without a head, is returned as it is.
        expressions: of the training frames.
        jaws: their jaws' rotations, axis-angle, radians.
    """
    shapes = student.blend_shapes
    if shapes is None or not _head(student.rig.template).any():
        return student
    found = []
    for motion in _unseen_motions(student, expressions, jaws):
        change = _open_mouth(student) if motion.kind == "jaw" else _closed_lids(student, motion.kind)
        if change is not None:
            found.append((motion, change))
    return student.with_blend_shapes(_extended(shapes, found)) if found else student


@torch.no_grad()
def on_drawn_face(student: Student) -> Student:
    """Return the student whose Gaussians of the head hang on the faces that they draw; at rest it looks the same.

    Training moves Gaussians by centimetres, so that one that draws a lip may hang on the chin and stay there when the
    mouth opens. Those within a centimetre of a face that shows at rest are bound to its nearest point: places, axes,
    sizes, harmonics and blend shapes are expressed in its frame. Those inside the mouth stay.
    """
    farthest, rig, template = 0.01, student.rig, student.rig.template
    shown = _shown_faces(template)
    if not shown.any():
        return student
    rest = rig.pose(_rest(template))
    frames, bound = triangle_frames(rig.skin(rest), rig.faces), student.gaussians()
    world = world_from_frames(student.compensated(rest), frames)
    before = bound.face_index.cpu().numpy()
    # Inside the mouth only those that left it.
    slid = bound.offset.square().sum(dim=1).add(bound.normal_offset.square()).sqrt().cpu().numpy()
    inside = inside_of_mouth(template)[template.faces[before]].all(axis=1)
    free = np.flatnonzero(_head(template)[before] & ~(inside & (slid < 0.003)))
    # The nearest point of what shows, for each Gaussian of the head.
    tree, faces, vertices = igl.AABB(), template.faces[shown], rig.skin(rest).double().cpu().numpy()
    tree.init(vertices, faces)
    means = world.means.double().cpu().numpy()
    squared, nearest, at = tree.squared_distance(vertices, faces, means[free])
    close = np.asarray(squared).reshape(-1) < farthest**2
    rows, now = free[close], np.flatnonzero(shown)[np.asarray(nearest).reshape(-1)[close]]
    if not len(rows):
        return student
    corners = vertices[template.faces[now]]
    share = np.asarray(igl.barycentric_coordinates(at[close], *(np.ascontiguousarray(corners[:, k]) for k in range(3))))
    barycentric = torch.tensor(share[:, :2]).to(bound.dc)
    # From the old triangle's frame to the new one's.
    device = bound.dc.device
    chosen = torch.tensor(rows, device=device)
    new, old = torch.tensor(now, device=device), bound.face_index[chosen]
    turn = frames.rotations[new].transpose(1, 2) @ frames.rotations[old]
    uncompensated = world_from_frames(bound, frames).means[chosen]
    values = dict(bound.tensors)
    place = on_triangles(frames.corners[new], barycentric)
    values["face_index"] = bound.face_index.index_copy(0, chosen, new)
    values["barycentric"] = bound.barycentric.index_copy(0, chosen, barycentric)
    moved = (frames.rotations[new].transpose(1, 2) @ (uncompensated - place)[..., None])[..., 0]
    values["offset"] = bound.offset.index_copy(0, chosen, moved)
    values["normal_offset"] = bound.normal_offset.index_fill(0, chosen, 0.0)
    longer = torch.log(frames.lengths[old] / frames.lengths[new])[:, None]
    values["log_scales"] = bound.log_scales.index_add(0, chosen, longer.expand(-1, 2).contiguous())
    values["quats"] = bound.quats.index_copy(0, chosen, multiply_quats(quat_from_matrix(turn), bound.quats[chosen]))
    values["sh"] = bound.sh.index_copy(0, chosen, rotate_sh(bound.sh[chosen], turn))
    out = student.with_blend_shapes(copy.deepcopy(student.blend_shapes))
    out.gaussians = LearnedGaussians(BoundGaussians(**values, face_count=bound.face_count, topology=bound.topology))
    if out.blend_shapes is not None:
        every = torch.eye(3).to(turn).repeat(len(bound), 1, 1).index_copy(0, chosen, turn)
        out.blend_shapes.U.copy_(every[out.blend_shapes.active] @ out.blend_shapes.U)
    return out


def _shown_faces(template: Template) -> Bool[np.ndarray, " F"]:
    """Mark the faces of the head's own surface that views from around it show at rest, as if it had no hair."""
    head = _head(template)
    shown = np.zeros(len(template.faces) + 1, dtype=bool)
    if not head.any():
        return shown[:-1]
    naked = np.flatnonzero(template.vertex_part[template.faces[:, 0]] == 0)
    mesh = TriangleMesh(template.vertices, template.faces[naked])
    used = template.vertices[np.unique(template.faces[head])]
    center, extent, size = used.mean(axis=0), float(np.ptp(used, axis=0).max()), 800
    for angle in np.deg2rad([0, 40, -40, 90, -90, 140, -140, 180]):
        direction = np.array([np.sin(angle), 0.0, np.cos(angle)])
        camera = Camera.orthographic_view(center=center, direction=direction, half_extent=0.6 * extent, size=size)
        ids = rasterize_mesh(mesh, camera).face_id
        shown[naked[ids[ids >= 0]]] = True
    return shown[:-1] & head


def _unseen_motions(
    student: Student, expressions: Float[Tensor, "T E"], jaws: Float[Tensor, "T 3"]
) -> list[UnseenMotion]:
    """Return the motions whose full strength training did not come near, with the strengths that it reached."""
    shapes, names = student.blend_shapes, list(student.rig.template.body.expression_names)
    assert shapes is not None, "a student with blend shapes"
    inputs = torch.cat([expressions, jaws], dim=1) if shapes.config.jaw else expressions
    seen, size = inputs.double().cpu().numpy(), expressions.shape[1]
    # Kind, weights, strength that shows enough, and how much beyond the seen one the shape takes to act fully.
    wanted = []
    for side in ("left", "right"):
        weights = np.zeros(seen.shape[1])
        if (name := f"eyeBlink{side.title()}") in names:
            weights[names.index(name)] = 1.0
            wanted.append((side, weights, 0.7, 0.5))
    weights = np.zeros(seen.shape[1])
    weights[size : size + 1] = 1.0
    if "jawOpen" in names:
        weights[names.index("jawOpen")] = _JAW_OPEN
    wanted.append(("jaw", weights, 0.25, 0.1))
    out = []
    for kind, weights, enough, more in wanted:
        most = max(0.0, float((seen @ weights).max()))
        if weights.any() and most < enough:
            begin = most if kind == "jaw" else max(most, 0.4)
            out.append(UnseenMotion(kind, weights, begin, begin + more))
    return out


def _closed_lids(student: Student, side: str) -> tuple[Tensor, Tensor] | None:
    """Return du and dc (N, 3) of closed lids: on their surface, in the colour of the skin around; the eye behind them.

    The skin's colour is the median of the lighter half of the 48 nearest Gaussians that the lids do not move, which
    leaves out brows and lashes.
    """
    template, names = student.rig.template, list(student.rig.template.body.expression_names)
    rest = _rest(template)
    both = [names.index(name) for name in ("eyeBlinkLeft", "eyeBlinkRight") if name in names]
    expression = rest.expression.copy()
    expression[0, both] = 1.0
    bound = student.compensated(student.rig.pose(replace(rest, expression=expression)))
    faces = template.faces[bound.face_index.cpu().numpy()]
    head = _head(template)[bound.face_index.cpu().numpy()]
    sides = {one: _lid_share(template, faces, head, one) for one in ("left", "right")}
    total = sum(share for share, _ in sides.values())
    share, ball = sides[side][0] / np.maximum(total, 1.0), sides["left"][1] | sides["right"][1]
    places = template.vertices[faces].mean(axis=1)
    still = head & (total == 0.0) & ~inside_of_mouth(template)[faces].any(axis=1)
    held, around = np.flatnonzero(share > 0.0), 48
    if not len(held) or still.sum() < around:
        return None
    colors = bound.dc.double().cpu().numpy()
    skin = colors[still][cKDTree(places[still]).query(places[held], k=around)[1]]
    light = np.argsort(skin.sum(axis=2), axis=1)[:, around // 2 :, None]
    skin = np.median(np.take_along_axis(skin, light, axis=1), axis=1)
    # Lashes and the shade between lids keep some of their darkness, which draws the line of a closed eye.
    line = 0.3 * (~ball[held] & (colors[held].sum(axis=1) < skin.sum(axis=1)))[:, None]
    target = colors.copy()
    target[held] = line * colors[held] + (1.0 - line) * skin
    # Lids within half a millimetre of their surface, the eye a millimetre behind its own.
    offset = bound.offset.clone()
    offset[:, 0] += bound.normal_offset
    goal = offset.clone()
    goal[:, 0] = torch.where(torch.tensor(ball, device=offset.device), -1e-3, offset[:, 0].clamp(-5e-4, 5e-4))
    weight = torch.tensor(share).to(offset)[:, None]
    return weight * (goal - offset), weight * torch.tensor(target - colors).to(offset)


def _lid_share(
    template: Template, faces: Int64[np.ndarray, "N 3"], head: Bool[np.ndarray, " N"], side: str
) -> tuple[Float64[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Return how much each face has to do with a side's blink, in [0, 1], and which are the eye itself.

    All of the eye and of the skin about its corners, which move little, and lids by how far they move.
    """
    rest, name = _rest(template), f"eyeBlink{side.title()}"
    if name not in template.body.expression_names:
        return np.zeros(len(faces)), np.zeros(len(faces), dtype=bool)
    expression = rest.expression.copy()
    expression[0, list(template.body.expression_names).index(name)] = 1.0
    moved = _travel(template, replace(rest, expression=expression))[faces].max(axis=1)
    share = np.where(head, np.clip((moved / max(moved.max(), 1e-12) - 0.1) / 0.3, 0.0, 1.0), 0.0)
    # The eye by its part of the body, where that has one; skin within 7 mm of it is its corners'.
    near, parts = 0.007, np.full(template.vertex_count, -1)
    parts[: template.body.vertex_count] = template.body.part_labels
    eyes = [k for k, part in enumerate(template.body.part_label_names) if part == f"{side}_eye"]
    ball = np.isin(parts[faces], eyes).all(axis=1) & head
    if ball.any():
        places = template.vertices[faces].mean(axis=1)
        share[head & (cKDTree(places[ball]).query(places)[0] < near)] = 1.0
    return share, ball


def _open_mouth(student: Student) -> tuple[Tensor, Tensor] | None:
    """Return du and dc (N, 3) of an open mouth: its inside in the template's colours, and nothing hanging before it.

    Large Gaussians of the lips, which would veil the opening, go three centimetres back into the head.
    """
    rig, template = student.rig, student.rig.template
    inside = inside_of_mouth(template)
    if not inside.any():
        return None
    pose = rig.pose(replace(_rest(template), jaw_pose=np.array([[_JAW, 0.0, 0.0]])))
    vertices = rig.skin(pose, student.displacements(pose))
    frames, bound = triangle_frames(vertices, rig.faces), student.compensated(pose)
    world, faces = world_from_frames(bound, frames), template.faces[bound.face_index.cpu().numpy()]
    # Pixels of the opening, seen from ahead, and how far from it each Gaussian is.
    extent, size = 0.06, 400  # half the view in metres, and its pixels
    mesh = TriangleMesh(vertices.double().cpu().numpy(), template.faces)
    camera = Camera.orthographic_view(
        center=mesh.vertices[inside].mean(axis=0), direction=np.array([0.0, 0.0, 1.0]), half_extent=extent, size=size
    )
    ids = rasterize_mesh(mesh, camera).face_id
    pixel = 2.0 * extent / size
    shown = (ids >= 0) & inside[template.faces[np.maximum(ids, 0)]].any(axis=2)
    # Its edge is the lips' to draw, two millimetres wide.
    opening = np.argwhere(distance_transform_edt(shown) * pixel > 0.002)
    if not len(opening):
        return None
    at = camera.screen_from_world(world.means.double().cpu().numpy())[:, 1::-1]
    away = cKDTree(opening + 0.5).query(at)[0] * pixel
    # A Gaussian of standard deviation s veils what is within 1.2 s of it; those that reach in by less than half a
    # centimetre are the lips themselves.
    reach, lips = 1.2, 0.005
    sigma = world.scales[:, 1:].amax(dim=1).double().cpu().numpy()
    skin = _head(template)[bound.face_index.cpu().numpy()] & ~inside[faces].all(axis=1)
    veil = torch.tensor(skin & ((reach * sigma - away > lips) | (away <= 0.0)), device=rig.device)
    back = frames.rotations[bound.face_index].transpose(1, 2) @ torch.tensor([0.0, 0.0, -0.03], device=rig.device)
    dark = torch.tensor(template.vertex_colors[faces].mean(axis=1) / 255.0).to(bound.dc) - bound.dc
    # Others inside show through the skin before them, whose colour they have.
    open_at = cKDTree(np.argwhere(shown) + 0.5).query(at)[0] * pixel < 0.001
    within = torch.tensor(inside[faces].all(axis=1) & open_at, device=rig.device)
    return veil[:, None] * back, within[:, None] * dark


def _extended(shapes: BlendShapes, found: Sequence[tuple[UnseenMotion, tuple[Tensor, Tensor]]]) -> BlendShapes:
    """Return blend shapes with further ones of the head, each driven by a motion's strength x alone.

    Their coefficient `z = (relu(x - begin) - relu(x - end)) / (end - begin)` takes two neurons of every hidden layer,
    which the others do not see.
    """
    config, more = shapes.config, len(found)
    heads, width = config.head_shapes, config.width
    wide = replace(config, head_shapes=heads + more, width=width + 2 * more)
    out = BlendShapes(wide, shapes.count, part=shapes.part, head_weight=shapes.head_weight, active=shapes.active)
    out = out.to(shapes.U)
    for name in ("head", "body"):
        layers, others = (
            [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
            for network in (getattr(out, name), getattr(shapes, name))
        )
        # The trained networks, whose new neurons are zero.
        for new, old in zip(layers[:-1], others[:-1], strict=True):
            new.weight.zero_()
            new.bias.zero_()
            new.weight[: old.weight.shape[0], : old.weight.shape[1]], new.bias[:width] = old.weight, old.bias
        new, old = layers[-1], others[-1]
        new.weight.zero_()
        new.bias.zero_()
        before = heads if name == "head" else config.body_shapes
        new.weight.view(config.parts, -1, wide.width)[:, :before, :width] = old.weight.view(config.parts, before, width)
        new.bias.view(config.parts, -1)[:, :before] = old.bias.view(config.parts, before)
    # Two neurons for each motion, handed from layer to layer.
    layers = [layer for layer in out.head.modules() if isinstance(layer, nn.Linear)]
    for k, (motion, _) in enumerate(found):
        for row, level, sign in ((width + 2 * k, motion.begin, 1.0), (width + 2 * k + 1, motion.end, -1.0)):
            layers[0].weight[row], layers[0].bias[row] = torch.tensor(motion.weights).to(out.U), -level
            for layer in layers[1:-1]:
                layer.weight[row, row] = 1.0
            last = layers[-1].weight.view(config.parts, heads + more, wide.width)
            last[:, heads + k, row] = sign / (motion.end - motion.begin)
    # Their changes stand behind the head's own.
    for name in ("U", "C"):
        old, new = getattr(shapes, name), getattr(out, name)
        new[..., :heads], new[..., heads + more :] = old[..., :heads], old[..., heads:]
    for k, (_, (du, dc)) in enumerate(found):
        out.U[..., heads + k], out.C[..., heads + k] = du[shapes.active], dc[shapes.active]
    return out


def _rest(template: Template) -> BodyParams:
    return BodyParams.rest(betas=template.body.num_betas, expressions=template.body.num_expressions)


def _head(template: Template) -> Bool[np.ndarray, " F"]:
    """Mark the faces of the head's own surface; none for a body without a head."""
    if "head" not in template.body.joint_names or template.part_names[0] != BODY_PART:
        return np.zeros(len(template.faces), dtype=bool)
    return head_faces(template) & (template.vertex_part[template.faces[:, 0]] == 0)


def _travel(template: Template, params: BodyParams) -> Float64[np.ndarray, " V"]:
    """Return how far each vertex is from its place at rest, metres."""
    return np.linalg.norm(template.pose(params)[0] - template.pose(_rest(template))[0], axis=1)
