"""Thick cloth without folds that cut themselves: what lies behind a sheet, as the level set of a field."""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Float, Float64, Int64

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import barycentric_coordinates

# Corners of a cube in the order of marching cubes' table.
_CUBE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
# Sizes in cells of the blocks that are looked at before the cells.
_BLOCKS = (8, 2)
# A field is never exactly 0 at a corner: faces without area would follow. A share of a cell.
_NOUGHT = 1e-3


def slab_behind(sheet: TriangleMesh, depth: Float[np.ndarray, " V"], *, cell: float) -> TriangleMesh:
    """The closed surface of what lies behind a sheet within a depth; it never cuts itself.

    The sheet is moved inward by half the depth; the field is the distance from there less half the depth at the nearest
    place. Rims are round. Marching cubes finds where the field is 0, in cells near there alone.

    Args:
        sheet: manifold, outward.
        depth: of each vertex, at least about two cells, changing slowly.
        cell: size of the grid's cells; metres, as all.
    """
    middle = sheet.with_vertices(sheet.vertices - 0.5 * depth[:, None] * sheet.vertex_normals)
    tree = igl.AABB()
    tree.init(middle.vertices, middle.faces)

    def field(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        squared, face, closest = tree.squared_distance(middle.vertices, middle.faces, points)
        bary = barycentric_coordinates(closest, middle.triangles[face])
        return np.sqrt(squared) - 0.5 * np.einsum("nk,nk->n", bary, depth[middle.faces[face]])

    # Half a block's diagonal, and by what the depth changes where the nearest place leaps from fold to fold.
    reach, leap = float(depth.max()), 0.5 * float(np.ptp(depth))
    low = sheet.vertices.min(axis=0) - reach - 2 * cell
    shape = np.ceil((np.ptp(sheet.vertices, axis=0) + 2 * reach + 4 * cell) / cell).astype(np.int64) + 1
    blocks = _cubes_of(np.ceil(shape / _BLOCKS[0]).astype(np.int64)) * _BLOCKS[0]
    for size, finer in zip(_BLOCKS, (*_BLOCKS[1:], 1), strict=True):
        blocks = blocks[np.abs(field(low + (blocks + 0.5 * size) * cell)) <= 0.9 * size * cell + leap]
        within = _cubes_of(np.full(3, size // finer)) * finer
        blocks = (blocks[:, None] + within).reshape(-1, 3)
    shape = blocks.max(axis=0) + 2
    corners = (blocks[:, None] + _CUBE).reshape(-1, 3)
    ids, index = np.unique((corners[:, 0] * shape[1] + corners[:, 1]) * shape[2] + corners[:, 2], return_inverse=True)
    places = low + np.stack(np.unravel_index(ids, shape), axis=1) * cell
    values = field(places)
    values[np.abs(values) < _NOUGHT * cell] = _NOUGHT * cell
    vertices, faces, _ = igl.marching_cubes(values, places, index.reshape(-1, 8).astype(np.int64), 0.0)
    return TriangleMesh(vertices, np.asarray(faces))


def _cubes_of(shape: Int64[np.ndarray, " 3"]) -> Int64[np.ndarray, "n 3"]:
    """All places of a grid."""
    return np.stack(np.unravel_index(np.arange(int(shape.prod())), shape), axis=1).astype(np.int64)
