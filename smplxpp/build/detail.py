"""Levels of detail: a template with fewer faces, which moves, speaks and looks as the whole one does.

Engines show figures far away with fewer faces. Skin that clothes cover is left out, because coarse skin would stick out
of coarse cloth, and every part is simplified by itself with its borders kept, so that collars, cuffs and hems meet the
skin as before.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.clean.simplify import simplify
from smplxpp.core import GeometryWarning, SkinWeights, TriangleMesh, require_at_least
from smplxpp.core.signed_distance import SignedDistanceField, barycentric_coordinates
from smplxpp.template.template import BODY_PART, Template
from smplxpp.template.template_arrays import fitted_regressor
from smplxpp.texture.bake import repainted

LEAST_FACES = 1000
"""Fewest faces of a level: below, the borders of clothes alone need more."""
# How much larger head and hands count than they are: people look there, and lids, lips and fingers are small. Chosen by
# eye on two people at 20,000 to 2,500 faces: at 1 a lid is lost at 10,000; at 3 limbs become prisms.
_EMPHASIS = {"head": 2.0, "left_wrist": 1.5, "right_wrist": 1.5, "left_ankle": 0.6, "right_ankle": 0.6}
# Skin is covered by parallel cloth (cosine of the normals) so far in front of it, or so far sunk into it, in metres. It
# stays within the margin of skin that shows: as far as a sleeve or a hem moves in motion.
_PARALLEL, _IN_FRONT, _SUNK = 0.5, 0.03, 0.005
_MARGIN = 0.03
# Parts share faces by this power of their own. Chosen with the emphasis: at 1 hair and trousers of 2,500 faces are
# torn, at 0.5 the face has none left at 5,000.
_SHARE = 0.7
_TEXELS = 1024  # a side of a level's texture; half of a template's own, as a level has half of its size on the screen
_DIRECTIONS = ("shapedirs", "exprdirs", "posedirs")


@dataclass(frozen=True)
class _Places:
    """A simplified part, and where on its source each vertex lies.

    Attributes:
        mesh: n vertices.
        corners: the template's vertices at the corners of the source face.
        shares: barycentric coordinates there.
        colors: mean colour of the source vertices that became the vertex.
    """

    mesh: TriangleMesh
    corners: Int64[np.ndarray, "n 3"]
    shares: Float64[np.ndarray, "n 3"]
    colors: Float64[np.ndarray, "n 3"]


def simplified_template(template: Template, faces: int) -> Template:
    """Return the template with about a given number of faces.

    Skin under clothes is left out but for a margin (`covered_faces`). Large parts give up more of their faces than
    small ones (`simplify`: edges collapsed by quadric error, borders and their vertices kept; head and hands count as
    larger than they are). A vertex of the result takes weights, expressions, and shape and pose bases of the nearest
    place on the source's faces that collapsed into it, so that upper and lower lip, or two fingers, cannot exchange
    theirs; its colour is their mean. A texture is painted again from the source's. Joints stay where they are and
    follow expressions as before.

    A template within the number is returned as it is.

    Args:
        template: body and parts in the T-pose.
        faces: of the result; borders alone may need more.

    Raises:
        InputError: fewer than 1,000 faces.
    """
    require_at_least("faces of a level of detail", faces, LEAST_FACES)
    if len(template.faces) <= faces:
        return template
    shown = ~covered_faces(template)
    space = _emphasised(template)
    faces_of = [template.part_faces(name) & shown for name in template.part_names]
    budgets = _shares(np.array([int(one.sum()) for one in faces_of]), faces)
    parts = [_simplified_part(template, *one, space) for one in zip(faces_of, budgets.tolist(), strict=True)]
    return repainted(_joined(template, parts), template, size=_TEXELS)


def _shares(counts: Int64[np.ndarray, " P"], faces: int) -> Int64[np.ndarray, " P"]:
    """Return how many faces each part keeps: by `_SHARE`, none more than it has."""
    budgets, open_ = np.zeros(len(counts)), counts > 0
    while open_.any():
        wanted = counts**_SHARE * open_
        budgets = np.where(open_, (faces - budgets[~open_].sum()) * wanted / wanted.sum(), budgets)
        full = open_ & (budgets >= counts)
        if not full.any():
            break
        budgets[full], open_ = counts[full], open_ & ~full
    return np.maximum(4, np.rint(budgets)).astype(np.int64)


def covered_faces(template: Template) -> Bool[np.ndarray, " F"]:
    """Return the faces of the body that its parts cover, farther than the margin from skin that shows.

    A face is covered if the nearest place on the parts is less than 3 cm in front of it, or 5 mm behind it where cloth
    has sunk in, is parallel to it and lies within the cloth, not on its border.
    """
    body = template.part_faces(BODY_PART)
    out = np.zeros(len(template.faces), dtype=bool)
    if body.all():
        return out
    skin = TriangleMesh(template.vertices, template.faces[body])
    centers = skin.triangles.mean(axis=1)
    found = SignedDistanceField(TriangleMesh(template.vertices, template.faces[~body]), solid=False).query(centers)
    parallel = np.einsum("ij,ij->i", found.normal, skin.face_normals) > _PARALLEL
    hidden = parallel & ~found.on_border & (found.distance > -_IN_FRONT) & (found.distance < _SUNK)
    if hidden.all() or not hidden.any():
        return out
    far = cKDTree(centers[~hidden]).query(centers, distance_upper_bound=_MARGIN)[0] > _MARGIN
    out[np.flatnonzero(body)] = hidden & far
    return out


def _emphasised(template: Template) -> tuple[Float64[np.ndarray, "V 3"], Float64[np.ndarray, " V"]]:
    """Return the vertices with head and hands enlarged about their joints, and by how much each is enlarged."""
    names, parents, weights = list(template.body.joint_names), template.body.parents, template.weights.dense()
    vertices, scale = template.vertices.copy(), np.ones(template.vertex_count)
    for name, factor in _EMPHASIS.items():
        if name not in names:
            continue
        below = np.zeros(len(names), dtype=bool)
        below[names.index(name)] = True
        for joint, parent in enumerate(parents.tolist()):
            below[joint] |= parent >= 0 and below[parent]
        more = (factor - 1.0) * weights[:, below].sum(axis=1)
        vertices += more[:, None] * (template.vertices - template.joints[names.index(name)])
        scale += more
    return vertices, scale


def _simplified_part(
    template: Template,
    faces: Bool[np.ndarray, " F"],
    budget: int,
    space: tuple[Float64[np.ndarray, "V 3"], Float64[np.ndarray, " V"]],
) -> _Places:
    """Simplify faces to a number of them; `space` is what `_emphasised` returns."""
    places, scale = space
    mesh, kept = TriangleMesh(places, template.faces).submesh(faces)
    if not mesh.face_count:
        return _Places(mesh, np.zeros((0, 3), np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    with warnings.catch_warnings():
        # Borders may need more faces: the caller sees how many there are.
        warnings.simplefilter("ignore", GeometryWarning)
        small = simplify(mesh, budget)
    # Candidates of a vertex are the source's faces with a corner that became it: about six, three times each.
    corner = small.new_from_old[mesh.faces]
    pairs = np.unique(np.stack([corner.ravel(), np.repeat(np.arange(mesh.face_count), 3)], axis=1), axis=0)
    pairs = pairs[pairs[:, 0] >= 0]
    # Vertices that a cut doubled share the candidates of the first: `source_vertex` tells which that is.
    first = small.new_from_old[small.source_vertex]
    start = np.searchsorted(pairs[:, 0], first)
    count = np.searchsorted(pairs[:, 0], first, side="right") - start
    vertex = np.repeat(np.arange(len(first)), count)
    face = pairs[np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(start, count), 1]
    shares, distance = _nearest_in(small.mesh.vertices[vertex], mesh.vertices[mesh.faces[face]])
    best = np.lexsort((distance, vertex))[np.cumsum(count) - count]
    # Mean colour of the source vertices that became a vertex, as a coarser level of a picture has it.
    used = np.flatnonzero(small.new_from_old >= 0)
    total = np.zeros((int(small.new_from_old.max()) + 1, 4))
    colors = np.pad(template.vertex_colors[kept[used]].astype(np.float64), ((0, 0), (0, 1)), constant_values=1.0)
    np.add.at(total, small.new_from_old[used], colors)
    # Back from the enlarged space: the place on the source, and the offset from there at the person's own size.
    corners, shares = kept[mesh.faces[face[best]]], shares[best]
    away = small.mesh.vertices - _mixed(shares, places[corners])
    vertices = _mixed(shares, template.vertices[corners]) + away / _mixed(shares, scale[corners])[:, None]
    colors = total[first, :3] / total[first, 3:]
    return _Places(TriangleMesh(vertices, small.mesh.faces), corners, shares, colors)


def _nearest_in(
    points: Float64[np.ndarray, "N 3"], triangles: Float64[np.ndarray, "N 3 3"]
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, " N"]]:
    """Return barycentric coordinates of the nearest point of each triangle, and its squared distance."""
    shares = np.zeros((len(points), 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = barycentric_coordinates(points, triangles)
    flat = (np.nan_to_num(inside, nan=-1.0) >= 0).all(axis=1)
    shares[flat] = inside[flat]
    nearest = np.where(flat, _squared(points, triangles, shares), np.inf)
    # Otherwise the nearest point is on an edge.
    for k in range(3):
        a, b = triangles[:, k], triangles[:, (k + 1) % 3]
        along = np.einsum("ij,ij->i", points - a, b - a) / np.maximum(np.einsum("ij,ij->i", b - a, b - a), 1e-30)
        on_edge = np.zeros_like(shares)
        on_edge[:, (k + 1) % 3] = np.clip(along, 0.0, 1.0)
        on_edge[:, k] = 1.0 - on_edge[:, (k + 1) % 3]
        distance = _squared(points, triangles, on_edge)
        closer = ~flat & (distance < nearest)
        shares[closer], nearest[closer] = on_edge[closer], distance[closer]
    return shares, nearest


def _squared(points: np.ndarray, triangles: np.ndarray, shares: np.ndarray) -> np.ndarray:
    return np.square(_mixed(shares, triangles) - points).sum(axis=1)


def _mixed(shares: Float64[np.ndarray, "N 3"], values: np.ndarray) -> np.ndarray:
    """Return the values (N, 3, ...) at the corners, mixed."""
    return np.einsum("nk,nk...->n...", shares, values)


def _joined(template: Template, parts: list[_Places]) -> Template:
    """Put simplified parts together as a template that moves as its source."""
    starts = np.cumsum([0, *(len(part.mesh.vertices) for part in parts)])
    corners, shares = (np.concatenate([getattr(part, name) for part in parts]) for name in ("corners", "shares"))
    vertices = np.concatenate([part.mesh.vertices for part in parts])
    # The corner with the largest share stands for what cannot be mixed.
    nearest = corners[np.arange(len(corners)), shares.argmax(axis=1)] if len(corners) else np.zeros(0, np.int64)
    count, body = int(starts[1]), template.body
    # Weights and bases are mixed; those of the body are indexed as its vertices, which come first.
    mixed: dict[str, Any] = {
        name: None if basis is None else _mixed(shares[:count], basis[corners[:count]])
        for name, basis in ((name, getattr(body, name)) for name in _DIRECTIONS)
    }
    regressor = np.zeros((body.joint_count, count))
    for k in range(3):
        # Each vertex starts with the regressor of the place that it lies on.
        regressor += shares[:count, k] * body.joint_regressor[:, corners[:count, k]]
    regressor = fitted_regressor(
        regressor,
        vertices[:count],
        mixed["exprdirs"],
        joints=template.joints,
        moved=np.tensordot(body.joint_regressor, body.exprdirs, axes=1),
        sums=body.joint_regressor.sum(axis=1),
    )
    dense = _mixed(shares, template.weights.dense()[corners])
    weights = SkinWeights.from_dense(dense, max_influences=template.weights.joint_indices.shape[1])
    kept = {name: getattr(template.weights, name)[nearest] for name in ("matched", "distance", "angle", "component")}
    surface = vertices[:count]
    return replace(
        template,
        texture=None,
        vertices=vertices,
        faces=np.concatenate([part.mesh.faces + start for part, start in zip(parts, starts, strict=False)]),
        vertex_labels=template.vertex_labels[nearest],
        vertex_part=np.repeat(np.arange(len(parts)), np.diff(starts)),
        vertex_colors=np.rint(np.concatenate([part.colors for part in parts])),
        weights=replace(
            template.weights, joint_indices=weights.joint_indices, joint_weights=weights.joint_weights, **kept
        ),
        body_index=np.concatenate([np.arange(count), cKDTree(surface).query(vertices[count:])[1]]),
        scan_index=template.scan_index[nearest],
        body=replace(
            body,
            v_template=surface,
            faces=parts[0].mesh.faces,
            joint_regressor=regressor,
            weights=dense[:count],
            part_labels=body.part_labels[nearest[:count]],
            landmarks={},
            **mixed,
        ),
    )
