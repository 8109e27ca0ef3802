"""Give a sheet of cloth a thickness: by offsets along its normals, or as the level set of a distance field."""

from __future__ import annotations

import igl
import numpy as np
from jaxtyping import Float, Float64, Int64

from smplxpp.core.foreign import MeshLike, as_mesh
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import barycentric_coordinates
from smplxpp.core.topology import border_loops, face_components


def thickened(
    sheet: MeshLike,
    *,
    inward: float | Float[np.ndarray, " V"],
    outward: float | Float[np.ndarray, " V"] = 0.0,
) -> TriangleMesh:
    """Return the closed mesh between a sheet's inward and outward offsets along its normals; borders become rims.

    It intersects itself in folds narrower than the thickness. Pieces that are closed already stay as they are.

    Args:
        sheet: manifold, every vertex used.
        inward: inward offset, metres, for all vertices or each.
        outward: outward offset, metres, for all vertices or each.
    """
    sheet = as_mesh(sheet, subject="sheet")
    # Find the components with a border.
    component = face_components(sheet.faces)
    is_open = np.zeros(int(component.max()) + 1, dtype=bool)
    of_vertex = np.zeros(sheet.vertex_count, dtype=np.int64)
    of_vertex[sheet.faces] = component[:, None]
    loops = border_loops(sheet.faces)
    is_open[[of_vertex[loop[0]] for loop in loops]] = True
    moved = is_open[of_vertex]
    normals, count = np.where(moved[:, None], sheet.vertex_normals, 0.0), sheet.vertex_count
    outer = sheet.vertices + normals * np.broadcast_to(outward, count)[:, None]
    inner = sheet.vertices - normals * np.broadcast_to(inward, count)[:, None]
    # Join both offsets by two triangles along each border edge.
    faces = [sheet.faces, sheet.faces[is_open[component]][:, ::-1] + count]
    for loop in loops:
        following = np.roll(loop, -1)
        faces += [
            np.stack([following, loop, loop + count], axis=1),
            np.stack([following, loop + count, following + count], axis=1),
        ]
    whole = TriangleMesh(np.concatenate([outer, inner]), np.concatenate(faces))
    return whole.submesh(np.ones(whole.face_count, dtype=bool))[0]


def slab_behind(sheet: TriangleMesh, depth: Float[np.ndarray, " V"], *, cell: float) -> TriangleMesh:
    """Return the closed surface of the volume behind a sheet within a depth; it never intersects itself.

    The sheet is moved inward by half the depth. The field at x is |x - y| - depth(y) / 2, with y the point of the moved
    sheet nearest to x; its zero level set, with round rims, comes from marching cubes in the cells near it.

    Args:
        sheet: manifold, oriented outward, metres.
        depth: depth at each vertex, metres; at least about two cells, changing slowly.
        cell: size of the grid's cells, metres.
    """
    middle = sheet.with_vertices(sheet.vertices - 0.5 * depth[:, None] * sheet.vertex_normals)
    tree = igl.AABB()
    tree.init(middle.vertices, middle.faces)

    def field(points: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, " n"]:
        squared, face, closest = tree.squared_distance(middle.vertices, middle.faces, points)
        bary = barycentric_coordinates(closest, middle.triangles[face])
        return np.sqrt(squared) - 0.5 * np.einsum("nk,nk->n", bary, depth[middle.faces[face]])

    # Search the level set coarse to fine: blocks of 8 cells, of 2, then cells. A block is kept if the field at its
    # centre is at most half its diagonal (0.87 of its size), plus the largest jump of the field, which occurs where the
    # nearest point leaps from fold to fold.
    reach, jump = float(depth.max()), 0.5 * float(np.ptp(depth))
    low = sheet.vertices.min(axis=0) - reach - 2 * cell
    shape = np.ceil((np.ptp(sheet.vertices, axis=0) + 2 * reach + 4 * cell) / cell).astype(np.int64) + 1
    sizes = (8, 2)
    blocks = _grid_indices(np.ceil(shape / sizes[0]).astype(np.int64)) * sizes[0]
    for size, finer in zip(sizes, (*sizes[1:], 1), strict=True):
        blocks = blocks[np.abs(field(low + (blocks + 0.5 * size) * cell)) <= 0.9 * size * cell + jump]
        within = _grid_indices(np.full(3, size // finer)) * finer
        blocks = (blocks[:, None] + within).reshape(-1, 3)
    # Corners of the cells, in the order of the marching cubes' table; corners that cells share are evaluated once.
    cube = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    shape = blocks.max(axis=0) + 2
    corners = (blocks[:, None] + cube).reshape(-1, 3)
    ids, index = np.unique((corners[:, 0] * shape[1] + corners[:, 1]) * shape[2] + corners[:, 2], return_inverse=True)
    places = low + np.stack(np.unravel_index(ids, shape), axis=1) * cell
    values = field(places)
    # A corner with the value 0 would give faces without area: values below a thousandth of a cell are raised to it.
    values[np.abs(values) < 1e-3 * cell] = 1e-3 * cell
    vertices, faces, _ = igl.marching_cubes(values, places, index.reshape(-1, 8).astype(np.int64), 0.0)
    return TriangleMesh(vertices, np.asarray(faces))


def _grid_indices(shape: Int64[np.ndarray, " 3"]) -> Int64[np.ndarray, "n 3"]:
    """Return the indices of all cells in a grid."""
    return np.stack(np.unravel_index(np.arange(int(shape.prod())), shape), axis=1).astype(np.int64)
