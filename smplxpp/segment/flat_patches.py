"""Find the flat patches of a surface, from both sides: boards of a binder; cloth and skin are curved or folded.

A point of the surface is the middle of a flat patch if its tangent plane covers a disc about it: with radius R and
the N samples whose normal is within 12 degrees of its own and which lie within 2 mm of its tangent plane,

    N area_of_a_sample >= 0.9 pi R^2.

All samples of such a disc are flat. R = 5 cm tells a plane from a limb: a cylinder of radius r lies within t of its
tangent plane over a width of 2 sqrt(2 r t), 2.5 cm on an arm and 5 cm on a trunk.

Where the surface comes back behind a flat patch within 5 cm, facing the other way, that is the board's back, and
flat, too.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from smplxpp.core import TriangleMesh
from smplxpp.core.surface_points import draw_on_surface

_RADIUS, _OFF_PLANE = 0.05, 0.002
"""Radius of a disc, and how far a sample may lie off its plane, metres; twice the noise of a good scan."""
_SAME_WAY = float(np.cos(np.radians(12.0)))
"""Cosine of the largest angle between normals of one plane."""
_COVERED = 0.9
"""Share of a disc that has to be in its plane; samples are drawn at random, so that no disc has all of them."""
_SPACING, _SMOOTHED = 0.01, 0.015
"""Distance of the samples, and the radius over which their normals are averaged against noise, metres."""
_TURNED = 0.03
"""Metres that a difference of unit normals counts as when the nearest sample is looked for."""
_THICKNESS = np.array([0.003, 0.01, 0.02, 0.03, 0.04, 0.05])
"""Thicknesses of boards, metres, at which their backs are looked for; limbs are thicker."""
_BESIDE, _OPPOSITE = 0.01, -0.7
"""Metres from that place within which a sample of the back lies, and the cosine between the normals of both."""


def flat_share(mesh: TriangleMesh, near: Bool[np.ndarray, " M"]) -> Float64[np.ndarray, " M"]:
    """Return the share of each face, 0 to 1, that lies on a flat patch at least 10 cm wide, or on its back.

    Args:
        mesh: the surface, metres.
        near: the faces to look at; the others get 0.

    Example:
        >>> from smplxpp.segment.flat_patches import flat_share
        >>> sheet = smplxpp.TriangleMesh([[0, 0, 0], [0.3, 0, 0], [0.3, 0.3, 0], [0, 0.3, 0]], [[0, 1, 2], [0, 2, 3]])
        >>> bool((flat_share(sheet, np.ones(2, dtype=bool)) > 0.9).all())
        True
    """
    out = np.zeros(mesh.face_count)
    part, _ = mesh.submesh(near)
    count = int(part.face_areas.sum() / _SPACING**2) if part.face_count else 0
    if not count:
        return out
    # Samples of equal area, with normals averaged over their neighbours on the same side.
    face, bary = draw_on_surface(part, count)
    points, own = np.einsum("nc,ncx->nx", bary, part.triangles[face]), part.face_normals[face]
    tree = cKDTree(points)
    one, other = tree.query_pairs(_SMOOTHED, output_type="ndarray").T
    beside = np.einsum("ij,ij->i", own[one], own[other]) > 0.7
    every = np.arange(count)  # a sample's own normal, then those of its neighbours
    into, given = (np.concatenate([every, a[beside], b[beside]]) for a, b in ((one, other), (other, one)))
    summed = np.stack([np.bincount(into, own[given, axis], count) for axis in range(3)], axis=1)
    normals = summed / np.linalg.norm(summed, axis=1, keepdims=True)
    flat = _with_backs(_flat(points, normals, tree), points, normals, tree)
    # A face has the share of its own samples, and that of the nearest sample that looks the same way if it has none.
    drawn = np.bincount(face, minlength=part.face_count)
    features = np.concatenate([part.face_centers, _TURNED * part.face_normals], axis=1)
    nearest = cKDTree(np.concatenate([points, _TURNED * normals], axis=1)).query(features)[1]
    share = np.bincount(face, flat, minlength=part.face_count) / np.maximum(drawn, 1)
    out[near] = np.where(drawn > 0, share, flat[nearest])
    return out


def _flat(points: np.ndarray, normals: np.ndarray, tree: cKDTree) -> Bool[np.ndarray, " N"]:
    """Return which samples lie on a flat disc."""
    # Each pair of neighbours in both orders: is the second in the plane of the first?
    pairs = tree.query_pairs(_RADIUS, output_type="ndarray")
    pairs = pairs[np.einsum("ij,ij->i", normals[pairs[:, 0]], normals[pairs[:, 1]]) > _SAME_WAY]
    middle, around = np.concatenate([pairs, pairs[:, ::-1]]).T
    inside = np.abs(np.einsum("ij,ij->i", normals[middle], points[around] - points[middle])) < _OFF_PLANE
    middle, around = middle[inside], around[inside]
    full = np.bincount(middle, minlength=len(points)) * _SPACING**2 > _COVERED * np.pi * _RADIUS**2
    flat = full.copy()
    flat[around[full[middle]]] = True
    return flat


def _with_backs(flat: np.ndarray, points: np.ndarray, normals: np.ndarray, tree: cKDTree) -> Bool[np.ndarray, " N"]:
    """Return the flat samples, and those on the other side of the same board."""
    out = flat.copy()
    for thickness in _THICKNESS:
        behind = points[flat] - thickness * normals[flat]
        far, at = tree.query(behind)
        opposite = np.einsum("ij,ij->i", normals[at], normals[flat]) < _OPPOSITE
        out[at[(far < _BESIDE) & opposite]] = True
    return out
