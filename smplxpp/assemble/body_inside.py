"""Adapt the body to its person: draw its feet into its shoes, part its lips, give it the colours of bare skin.

The shape of a body has one foot for everybody: it is longer than a small shoe, stands flat in a heel, and its toes
come through the front. No one sees a foot in a shoe, and a shoe is stiff, so that the foot yields: a vertex in
front of the shoe's surface goes to the nearest place behind it. The joints stay where they are. With the moved
vertices v' and the row r of a joint's regressor, the new row is r' = r (1 + [v' 1] y) with the y that solves

    sum_i r'_i v'_i = sum_i r_i v_i,    sum_i r'_i = sum_i r_i,

the smallest change relative to r.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve

from smplxpp.body import BodyModel
from smplxpp.core import InputError, SkinWeights, TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField

_LEATHER = 0.002
"""Metres behind the surface of a shoe at which the skin begins; soles are thicker, the uppers of pumps are as thin."""
_FARTHEST = 0.08
"""Largest length in metres that a vertex is drawn in; what lies farther from every shoe is not in one."""
_ROUNDS = 4
"""Rounds of drawing in; after the first, a vertex may have come in front of another side of the shoe."""


def feet_in_shoes(
    body: BodyModel, rest: Float64[np.ndarray, "V 3"], shoes: list[tuple[TriangleMesh, SkinWeights]]
) -> tuple[Float64[np.ndarray, "V 3"], BodyModel]:
    """Return the body's vertices with its feet inside the shoes, and the model whose joints stay where they were.

    Args:
        body: the body model.
        rest: its vertices in the T-pose, metres.
        shoes: open surfaces in the T-pose, outward, with their skin weights. Toes bend as far as the shoe around them.

    Example:
        >>> from smplxpp.assemble.body_inside import feet_in_shoes
        >>> body = smplxpp.load_body()
        >>> same, _ = feet_in_shoes(body, body.v_template, [])
        >>> bool((same == body.v_template).all())
        True
    """
    moved, weights = rest.copy(), body.weights.copy()
    middle = float(rest[:, 0].mean())
    for side, (shoe, bound) in product(("left", "right"), shoes):
        # In the T-pose the left shoe lies on the side of the left foot, +x.
        own = (shoe.face_centers[:, 0] > middle) == (side == "left")
        if not (shoe.face_areas[own] > 0).any():
            continue
        foot = [body.joint_names.index(f"{side}_{joint}") for joint in ("ankle", "foot")]
        rows = np.flatnonzero(body.weights[:, foot].sum(axis=1) > 0.5)
        # The largest weight of the toes' joint in the shoe is the share of their turn that it makes.
        bends = float(bound.dense()[:, foot[1]].max())
        weights[:, foot] += (1.0 - bends) * weights[:, foot[1:]] * [1.0, -1.0]
        field = SignedDistanceField(shoe.submesh(own)[0], solid=False)
        for _ in range(_ROUNDS):
            found = field.query(moved[rows])
            # Beside the opening the surface has no sides; there the foot leaves the shoe.
            out = (found.distance > -_LEATHER) & (found.distance < _FARTHEST) & ~found.on_border
            if not out.any():
                break
            moved[rows[out]] = found.closest[out] - 1.01 * _LEATHER * found.normal[out]
    changed = np.abs(moved - rest).max(axis=1) > 0
    if not shoes:
        return rest, body
    # Rows of joints that depend on a moved vertex.
    regressor = body.joint_regressor.copy()
    for joint in np.flatnonzero((regressor[:, changed] != 0).any(axis=1)):
        used = np.flatnonzero(regressor[joint])
        row, places = regressor[joint, used], np.concatenate([moved[used], np.ones((len(used), 1))], axis=1)
        missing = np.append(row @ (rest[used] - moved[used]), 0.0)
        y = np.linalg.lstsq(places.T @ (row[:, None] * places), missing, rcond=None)[0]
        regressor[joint, used] = row * (1.0 + places @ y)
    return moved, replace(body, joint_regressor=regressor, weights=weights)


def part_lips(body: BodyModel) -> BodyModel:
    """Return the model with skinning weights of the jaw that do not leak from one lip to the other.

    Weights that were carried over by distance hang some vertices of a closed mouth's upper lip on the jaw, which draws
    fangs from it across an open mouth. Where the jaw's weight jumps along an edge, the rows at its ends become the
    mean of their neighbours' (harmonic), which keeps their sums.

    Args:
        body: any body model; one without a jaw, or whose weights do not jump, is returned as it is.

    Example:
        >>> from smplxpp.assemble.body_inside import part_lips
        >>> body = smplxpp.load_body()
        >>> int((part_lips(body).weights != body.weights).any(axis=1).sum())
        18
    """
    jump = 0.35  # of the jaw's weight along an edge: in corners of mouths it is at most 0.32 in the open body
    if "jaw" not in body.joint_names:
        return body
    jaw = body.weights[:, body.joint_names.index("jaw")]
    edges = np.unique(
        np.sort(np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]])), axis=0
    )
    leaking = np.unique(edges[np.abs(jaw[edges[:, 0]] - jaw[edges[:, 1]]) > jump])
    if not len(leaking):
        return body
    # Uniform Laplacian of the leaking rows; a trace of their own weights holds those that have no other neighbours.
    count, own = body.vertex_count, 1e-9
    ends = np.concatenate([edges, edges[:, ::-1]])
    near = csr_array((np.ones(len(ends)), ends.T), shape=(count, count))[leaking]
    inner = near[:, leaking]
    fixed = near @ np.where(np.isin(np.arange(count), leaking)[:, None], 0.0, body.weights)
    matrix = diags_array(near.sum(axis=1) + own) - inner
    weights = body.weights.copy()
    weights[leaking] = spsolve(matrix.tocsc(), fixed + own * body.weights[leaking])
    return replace(body, weights=weights)


def body_colors_from_scan(
    posed_body: TriangleMesh,
    scan: TriangleMesh,
    scan_colors: UInt8[np.ndarray, "N 3"],
    skin_faces: Bool[np.ndarray, " M"],
    *,
    max_distance: float = 0.015,
) -> tuple[UInt8[np.ndarray, "V 3"], Int64[np.ndarray, " V"]]:
    """Colour every body vertex that the scan shows bare; the others get the median colour of the visible skin.

    A vertex is shown if its closest point on the scan's skin is near and the normals agree in direction.

    Args:
        posed_body: the body in the scan's pose.
        scan: the scan.
        scan_colors: (N, 3) uint8 of the scan's vertices.
        skin_faces: (M,) whether a face of the scan is skin.
        max_distance: largest distance to the scan, metres.

    Returns:
        colors: (V, 3) uint8.
        scan_index: (V,) the scan's vertex that gave the colour, or -1.

    Raises:
        InputError: arrays that do not fit the scan.
    """
    if np.shape(scan_colors) != (scan.vertex_count, 3) or np.shape(skin_faces) != (scan.face_count,):
        raise InputError(
            "scan colours and skin faces",
            expected=f"({scan.vertex_count}, 3) and ({scan.face_count},)",
            received=f"{np.shape(scan_colors)} and {np.shape(skin_faces)}",
        )
    # Without any skin the body is grey.
    colors = np.full((posed_body.vertex_count, 3), 180, dtype=np.uint8)
    scan_index = np.full(posed_body.vertex_count, -1, dtype=np.int64)
    if not skin_faces.any():
        return colors, scan_index
    # Closest points on the scan's skin; a vertex takes the colour of the nearest corner there.
    skin, used = scan.submesh(skin_faces)
    tree = igl.AABB()
    tree.init(skin.vertices, skin.faces)
    squared, face, closest = tree.squared_distance(skin.vertices, skin.faces, posed_body.vertices)
    squared, face = np.asarray(squared).reshape(-1), np.asarray(face).reshape(-1)
    facing = np.einsum("ij,ij->i", posed_body.vertex_normals, skin.face_normals[face]) > 0
    shown = (squared <= max_distance**2) & facing
    corner = np.linalg.norm(skin.triangles[face] - closest[:, None], axis=2).argmin(axis=1)
    source = used[skin.faces[face, corner]]
    scan_index[shown] = source[shown]
    colors[:] = np.median(np.asarray(scan_colors)[used], axis=0)
    colors[shown] = np.asarray(scan_colors)[source[shown]]
    return colors, scan_index
