"""Bridges of openings: faces with which a scan closes the gap under a hem or in a sleeve, where it has no depth."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from smplxpp.cloth.cloth_mesh import (
    SHORTEST_OPENING,
    geodesics,
    looks_inwards,
    loop_length,
    opening_axis,
    turned_over,
)
from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.topology import border_loops, face_adjacency, face_components
from smplxpp.template.template import BODY_PART, Template

# Metres from an opening's border: a bridge is as wide as the gap between a hem and what it hangs over.
REACH = 0.035
# Cosine to the opening's axis from which a surface closes the opening instead of going on to it.
_VERTEX, _FACE = 0.35, 0.2
# Cosine of its axis to the vertical from which an opening looks up: shoulders lie about a neckline and look up as well.
_UPWARDS = 0.3
# Metres behind a bridge at which there is nothing but the inside of the garment; behind cloth that lies on the body
# there is the body.
_HOLLOW = (0.03, 0.06)


def find_opening_bridges(template: Template) -> Bool[np.ndarray, " F"]:
    """Find the faces of a template's clothes that close an opening, in the T-pose.

    A scan runs from a hem's edge inwards to the leg. Such faces lie within `REACH` of the part's border, look along the
    opening's axis, which cloth that continues to the border does not, and have a hollow behind them. Small pieces that
    only such faces join to the rest are bridges, too. A body without an inside has none.
    """
    out = np.zeros(len(template.faces), dtype=bool)
    parts = template.cloth_parts
    if not parts:
        return out
    skin = template.part_mesh(BODY_PART)
    try:
        body = SignedDistanceField(skin, solid=True)
    except InputError:  # without an inside of the body there are no hollows
        return out
    for part in parts:
        faces = template.part_faces(part)
        cloth = template.mesh.submesh(faces)[0]
        out[faces] = _bridges_of(turned_over(cloth) if looks_inwards(cloth, skin) else cloth, body)
    return out


def _bridges_of(mesh: TriangleMesh, body: SignedDistanceField) -> Bool[np.ndarray, " M"]:
    bridges = np.zeros(mesh.face_count, dtype=bool)
    for loop in border_loops(mesh.faces):
        if loop_length(mesh, loop) < SHORTEST_OPENING:
            continue
        axis = opening_axis(mesh, loop)
        if axis[1] > _UPWARDS:
            continue
        # Faces near such an opening that look along its axis close it like a lid: all corners do, or the face and
        # one corner.
        near = geodesics(mesh, loop)[0] < REACH
        looks = (near & (mesh.vertex_normals @ axis > _VERTEX))[mesh.faces]
        along = near[mesh.faces].any(axis=1) & (mesh.face_normals @ axis > _FACE)
        bridges |= looks.all(axis=1) | (looks.any(axis=1) & along)
    found = np.flatnonzero(bridges)
    # Behind a true bridge there is air. Faces with the body behind them are the garment itself and stay.
    for depth in _HOLLOW:
        behind = mesh.face_centers[found] - depth * mesh.face_normals[found]
        found = found[body.query(behind).distance > 0] if len(found) else found
    bridges[:] = False
    bridges[found] = True
    return bridges | _crumbs(mesh, bridges)


def _crumbs(mesh: TriangleMesh, bridges: Bool[np.ndarray, " M"]) -> Bool[np.ndarray, " M"]:
    """The pieces that bridges alone join to the rest and that are smaller than these: holes in what was found of a
    bridge.

    As cloth they would be carried by what is nearest, up to a decimetre away, and be torn when that swings.
    """
    left = np.flatnonzero(~bridges)
    piece = np.full(mesh.face_count, -1)
    piece[left] = face_components(mesh.faces[left])
    pairs = face_adjacency(mesh.faces)[0]
    across = bridges[pairs[:, 0]] != bridges[pairs[:, 1]]
    beside = np.unique(piece[pairs[across]])
    areas = np.bincount(piece[left], weights=mesh.face_areas[left], minlength=1)
    small = (beside >= 0) & (areas[beside] < mesh.face_areas[bridges].sum())
    return np.isin(piece, beside[small])
