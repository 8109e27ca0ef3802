"""Transfer the colours of bare skin from the scan to the body."""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Bool, Int64, UInt8

from smplxpp.core import InputError, TriangleMesh


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
