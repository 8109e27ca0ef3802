"""What the transfer needs of its meshes, and what it mends with a warning."""

from __future__ import annotations

import warnings

import igl
import numpy as np

from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.mesh import TriangleMesh


def check_source(source: TriangleMesh, weights: np.ndarray) -> np.ndarray:
    """Checked (V, J) float64 weights, rows summing to exactly 1.

    Raises:
        InputError: no faces; wrong shape; NaN; negative; a row that does not sum to 1 within 1e-4.
    """
    if not source.face_count or not source.face_areas.any():
        raise InputError(
            "source mesh", expected="faces with area", received=f"{source.face_count} faces without any area"
        )
    weights = np.asarray(weights, dtype=np.float64)
    if weights.ndim != 2 or len(weights) != source.vertex_count or not weights.shape[1]:
        raise InputError(
            "source weights", expected=f"shape ({source.vertex_count}, J)", received=f"shape {weights.shape}"
        )
    used = np.unique(source.faces)
    rows = weights[used]
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise InputError(
            "source weights",
            expected="finite values",
            received=f"NaN or infinity, first at vertex {used[np.argmax(bad)]}",
        )
    total = rows.sum(axis=1)
    bad = (rows < 0).any(axis=1) | (np.abs(total - 1.0) > 1e-4)
    if bad.any():
        first = np.argmax(bad)
        raise InputError(
            "source weights",
            expected="rows without negative values that sum to 1",
            received=f"{int(bad.sum())} other rows, first at vertex {used[first]} with sum {total[first]:.6g}",
            remedy="normalise the body model's weights",
        )
    out = np.zeros_like(weights)
    out[used] = rows / total[:, None]
    return out


def check_placement(source: TriangleMesh, target: TriangleMesh, nearest: np.ndarray) -> None:
    """Refuse a target that plainly does not lie on the source: other units, other axes, another place.

    Args:
        nearest: (N,) distance of each target vertex to the source.

    Raises:
        InputError: names the likely cause.
    """
    if not target.face_count:
        raise InputError("target mesh", expected="at least one face", received="none")
    size = source.bbox_diagonal
    ratio = target.bbox_diagonal / size
    far = float(np.median(nearest)) / size
    if ratio <= 3.0 and far <= 0.25:
        return
    low, high = (np.round(f(target.vertices[np.unique(target.faces)], axis=0), 3) for f in (np.min, np.max))
    received = f"a target of box {low} to {high}, {ratio:.3g} times the source's size, median distance {far:.3g} of it"
    factor = next((f for f in (1000.0, 100.0, 10.0) if ratio / f < 1.5 and ratio / f > 0.02), None)
    if ratio > 3.0:
        remedy = (
            f"the units seem to differ: divide the target's coordinates by {factor:.0f}"
            if factor
            else "check the units"
        )
    else:
        remedy = (
            "check units, axes (+Y up) and translation of both meshes"
            if not _fits_after_axis_swap(source, target)
            else "the axes seem to differ (for example +Z up): rotate the target so that +Y is up"
        )
    raise InputError("target mesh placement", expected="a part worn by the source", received=received, remedy=remedy)


def _fits_after_axis_swap(source: TriangleMesh, target: TriangleMesh) -> bool:
    """Whether the target's box lies in the source's after some signed permutation that is not the identity."""
    body = source.vertices[np.unique(source.faces)]
    low, high = body.min(axis=0), body.max(axis=0)
    pad = 0.1 * float(np.linalg.norm(high - low))
    points = target.vertices[np.unique(target.faces)]
    for axes, sign in (
        ((0, 2, 1), (1, 1, -1)),
        ((0, 2, 1), (1, -1, 1)),
        ((1, 0, 2), (1, -1, 1)),
        ((1, 0, 2), (-1, 1, 1)),
    ):
        turned = points[:, axes] * sign
        if (turned.min(axis=0) >= low - pad).all() and (turned.max(axis=0) <= high + pad).all():
            return True
    return False


def consistent_winding(mesh: TriangleMesh, *, subject: str) -> TriangleMesh:
    """The mesh with neighbouring faces wound alike; warns with the number of faces turned, keeps the majority's side.

    Two faces agree when they run along their common edge in opposite directions. Edges of three or more faces say nothing.
    """
    f = mesh.faces
    directed = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    _, counts = np.unique(directed[:, 0] * mesh.vertex_count + directed[:, 1], return_counts=True)
    if counts.max(initial=1) == 1:
        return mesh
    oriented, patch = igl.bfs_orient(f)
    flipped = _cyclic(oriented) != _cyclic(f)
    size = np.bincount(patch)
    turned = np.bincount(patch, flipped) > 0.5 * size  # more than half turned: turn the others instead
    flipped ^= turned[patch]
    if not flipped.any():
        return mesh
    warnings.warn(
        f"{subject}: {int(flipped.sum())} of {len(f)} faces were wound against their neighbours; turned",
        GeometryWarning,
        stacklevel=4,
    )
    faces = f.copy()
    faces[flipped] = faces[flipped][:, ::-1]
    return TriangleMesh(mesh.vertices, faces)


def _cyclic(faces: np.ndarray) -> np.ndarray:
    """(M,) bool parity of each face: whether its corners, from the lowest index on, increase."""
    start = faces.argmin(axis=1)
    rows = np.arange(len(faces))
    return faces[rows, (start + 1) % 3] < faces[rows, (start + 2) % 3]
