"""Extract the soft visual hull, the zero set of the smallest depth in all silhouettes, by adaptive marching cubes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import igl
import manifold3d
import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy import ndimage

from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.topology import face_components
from smplxpp.reconstruct.views import Box, Silhouette, smallest_depths

Field = Callable[[Float32[np.ndarray, "N 3"]], Float32[np.ndarray, " N"]]
"""Depth inside the surface at (N, 3) points, metres, negative outside; Lipschitz with constant 1."""
_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
# For each of the six faces of a cell: the step to its neighbour, and the face's corners.
_FACES = [
    (np.eye(3, dtype=np.int64)[axis] * (1 if side else -1), np.flatnonzero(_CORNERS[:, axis] == side))
    for axis in range(3)
    for side in (0, 1)
]
# Added to cell coordinates before they are packed, so that cells a few steps outside the grid are positive too.
_SHIFT = 64


def soft_hull(silhouettes: Sequence[Silhouette], box: Box, *, cell: float, dissent: int = 0) -> TriangleMesh:
    """Return the closed surface of the points inside all silhouettes, or inside all but `dissent` of them.

    Args:
        silhouettes: of the views.
        box: that holds the body.
        cell: distance of the field's samples, metres; edges of the surface are a little shorter.
        dissent: number of views that may reject a point.

    Raises:
        InputError: nothing lies in all silhouettes.
    """

    def field(points: np.ndarray) -> np.ndarray:
        return smallest_depths(silhouettes, points, count=dissent + 1)[:, dissent]

    return zero_surface(field, box, cell=cell)


def zero_surface(
    field: Field, box: Box, *, cell: float, coarsest: float = 0.02, smoothing: float = 0.0
) -> TriangleMesh:
    """Return the closed, outward surface on which a field is zero, by marching cubes on cells refined around it.

    A cell is refined if the field at its centre is below half the cell's diagonal, with 5 % to spare. For a Lipschitz
    field no other cell can contain the surface.

    Args:
        field: depth inside the surface.
        box: that holds the surface.
        cell: size of the finest cells, metres.
        coarsest: size of the first cells, metres; larger ones save time where the field is Lipschitz everywhere.
        smoothing: standard deviation of a Gaussian over the field, truncated at one cell, metres. Sheets and slits
            thinner than twice it vanish, at which the field jumps; a plane stays where it is.

    Raises:
        InputError: the field is positive nowhere.
    """

    def within(points: np.ndarray) -> np.ndarray:
        """Return the field, cut off at the sides of the box."""
        to_side = np.minimum(points - box.low.astype(np.float32), box.high.astype(np.float32) - points).min(axis=1)
        return np.minimum(field(points), to_side)

    # Start with coarse cells and halve them until they have the requested size.
    halvings = max(0, round(float(np.log2(coarsest / cell))))
    size = cell * 2**halvings
    # One more layer of cells on every side closes the surface.
    counts = np.ceil((box.high - box.low) / size).astype(np.int64) + 2
    origin = 0.5 * (box.low + box.high) - 0.5 * counts * size
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    for level in range(halvings + 1):
        if level:
            cells = (2 * cells[:, None] + _CORNERS).reshape(-1, 3)
            size /= 2
        middle = within((origin + (cells + 0.5) * size).astype(np.float32))
        cells = cells[np.abs(middle) <= 0.5 * np.sqrt(3) * size * 1.05]
    if not len(cells):
        raise InputError(
            "silhouettes",
            expected="a body that lies in all of them",
            received="none",
            remedy="look at masks and cameras (`smplxpp capture check`)",
        )
    corners, index, values = _closed(cells, within, origin, size)
    if smoothing:
        corners, index, values = _smoothed(corners, values, size, smoothing)
    vertices, faces, _ = igl.marching_cubes(values, origin + corners * size, index, 0.0)
    if not len(faces):
        raise InputError("silhouettes", expected="a body that lies in all of them", received="none")
    return TriangleMesh(vertices, faces)


def _closed(
    cells: Int64[np.ndarray, "N 3"], field: Field, origin: np.ndarray, size: float
) -> tuple[Int64[np.ndarray, "C 3"], Int64[np.ndarray, "M 8"], Float64[np.ndarray, " C"]]:
    """Return corners, cells as rows of corners, and the corners' values (negative inside), with all cells that the
    surface crosses.

    At the edge of a view the field jumps and is not Lipschitz, so that refinement misses cells there. They are added by
    following the surface through the faces of known cells (flood fill).
    """
    known, front = np.unique(_keys(cells)), cells
    keys, values = [], []
    while len(front):
        corner_keys, index = np.unique(_keys((front[:, None] + _CORNERS).reshape(-1, 3)), return_inverse=True)
        found = -field((origin + _cells_of(corner_keys) * size).astype(np.float32)).astype(np.float64)
        # Marching cubes expects negative values inside; a zero at a corner would give faces without area.
        found = np.where(np.abs(found) < 1e-3 * size, -1e-3 * size, found)
        keys.append(corner_keys)
        values.append(found)
        # The surface crosses a face whose corners differ in sign; the cell on its other side belongs to the surface.
        inside = found[index.reshape(-1, 8)] < 0
        neighbours = []
        for direction, face in _FACES:
            crossed = inside[:, face].any(axis=1) & ~inside[:, face].all(axis=1)
            neighbours.append(_keys(front[crossed] + direction))
        more = np.setdiff1d(np.concatenate(neighbours), known)
        known, front = np.union1d(known, more), _cells_of(more)
    corner_keys, first = np.unique(np.concatenate(keys), return_index=True)
    found = np.concatenate(values)[first]
    index = np.searchsorted(corner_keys, _keys((_cells_of(known)[:, None] + _CORNERS).reshape(-1, 3)))
    return _cells_of(corner_keys), index.reshape(-1, 8), found


def _smoothed(
    corners: Int64[np.ndarray, "C 3"], values: Float64[np.ndarray, " C"], size: float, smoothing: float
) -> tuple[Int64[np.ndarray, "D 3"], Int64[np.ndarray, "M 8"], Float64[np.ndarray, " D"]]:
    """Return corners, cells and values of a field, truncated at one cell, after a Gaussian filter."""
    low = corners.min(axis=0) - 1
    dense = np.zeros(np.ptp(corners, axis=0) + 3, np.float32)
    dense[tuple((corners - low).T)] = np.clip(values, -size, size)
    # Regions without a sample lie on one side of the surface: that of the samples around them.
    region, count = ndimage.label(dense == 0.0)
    side = np.full(count + 1, np.float32(size))
    for axis in range(3):
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        for unknown, known in ((ahead, behind), (behind, ahead)):
            within = (region[tuple(unknown)] > 0) & (dense[tuple(known)] < 0)
            side[region[tuple(unknown)][within]] = -size
    dense = np.where(region > 0, side[region], dense)
    dense = ndimage.gaussian_filter(dense, smoothing / size, mode="nearest", truncate=3.0)
    dense[dense == 0.0] = -1e-3 * size
    # Keep the cells whose corners differ in sign.
    inside = dense < 0
    some, every = inside[:-1, :-1, :-1].copy(), inside[:-1, :-1, :-1].copy()
    for x, y, z in _CORNERS[1:]:
        one = inside[x : x + some.shape[0], y : y + some.shape[1], z : z + some.shape[2]]
        some, every = some | one, every & one
    cells = np.argwhere(some & ~every)
    keys, index = np.unique(_keys((cells[:, None] + _CORNERS).reshape(-1, 3)), return_inverse=True)
    used = _cells_of(keys)
    return used + low, index.reshape(-1, 8), dense[tuple(used.T)].astype(np.float64)


def _keys(cells: np.ndarray) -> np.ndarray:
    """Pack the three coordinates of each cell into one integer, 21 bits each."""
    x, y, z = (cells + _SHIFT).T
    return (x << 42) | (y << 21) | z


def _cells_of(keys: np.ndarray) -> np.ndarray:
    """Unpack the coordinates of cells from their integers."""
    low = (1 << 21) - 1
    return np.stack([keys >> 42, keys >> 21 & low, keys & low], axis=1) - _SHIFT


def main_body(mesh: TriangleMesh) -> tuple[TriangleMesh, list[str]]:
    """Return the component of largest volume of a closed surface, and notes about others of over a fifth of it.

    Raises:
        InputError: no piece encloses a volume.
    """
    piece = face_components(mesh.faces)
    center = mesh.vertices.mean(axis=0)
    volume = np.bincount(piece, np.einsum("ij,ij->i", mesh.face_centers - center, mesh.face_cross) / 6.0)
    largest = int(volume.argmax())
    if not volume[largest] > 0:
        raise InputError("silhouettes", expected="a body that lies in all of them", received="no volume")
    others = np.flatnonzero((volume > 0.2 * volume[largest]) & (np.arange(len(volume)) != largest))
    notes = [f"another body of {1e3 * volume[k]:.0f} litres beside that of {1e3 * volume[largest]:.0f}" for k in others]
    return mesh.submesh(piece == largest)[0], notes


def solid_status(mesh: TriangleMesh) -> tuple[str, int]:
    """Return the status of a surface in manifold3d, "NoError" if it is a closed manifold, and its genus."""
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(mesh.vertices.copy(), mesh.faces.astype(np.uint64))  # manifold3d refuses read-only arrays
    )
    status = solid.status().name
    return status, int(solid.genus()) if status == "NoError" else 0


def pixel_footprint(silhouettes: Sequence[Silhouette], center: Float64[np.ndarray, " 3"]) -> float:
    """Return the size of a pixel at a point, metres, as the median over the views."""
    z = [float((one.camera.cam_from_world[:3] @ np.append(center, 1.0))[2]) for one in silhouettes]
    return float(np.median([one.pixel * depth for one, depth in zip(silhouettes, z, strict=True)]))
