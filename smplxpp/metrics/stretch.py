"""Stretch between two poses of one topology: edges that tear, faces that turn over."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.core import InputError, MeshLike, TriangleMesh, as_mesh, require_positive, row_lengths


@dataclass(frozen=True)
class StretchReport:
    """Edge length ratios `posed / rest` and turned faces.

    Attributes:
        edge_count: edges measured.
        degenerate_edges: left out, without length at rest.
        p50, p99, p999, max, min: of the ratio.
        limit: of the flag.
        flagged_edges: edges longer than `limit` times their rest length.
        flipped_faces: see `flipped_faces`.
    """

    edge_count: int
    degenerate_edges: int
    p50: float
    p99: float
    p999: float
    max: float
    min: float
    limit: float
    flagged_edges: int
    flipped_faces: int

    def as_dict(self) -> dict:
        """Return the figures as plain numbers for JSON."""
        return asdict(self)


def edge_stretch(rest: MeshLike, posed: MeshLike) -> Float64[np.ndarray, " E"]:
    """The length of each of `rest.edges` in the pose over that at rest; NaN for an edge without length at rest.

    Raises:
        InputError: the meshes differ in faces or number of vertices, or have no faces.
    """
    rest = as_mesh(rest, subject="rest mesh")
    posed = as_mesh(posed, subject="posed mesh")
    _check_same_topology(rest, posed)
    i, j = rest.edges.T
    before, after = (row_lengths(m.vertices[j] - m.vertices[i]) for m in (rest, posed))
    return np.divide(after, before, out=np.full(len(before), np.nan), where=before > 0)


def flipped_faces(rest: MeshLike, posed: MeshLike) -> Bool[np.ndarray, " M"]:
    """The faces that agree with their edge neighbours at rest and oppose them in the pose.

    A face opposes its neighbours when its normal has a negative dot product with the sum of their area vectors.
    Relative to the neighbours, so that the pose's own rotation does not count.

    Raises:
        InputError: as `edge_stretch`.
    """
    rest = as_mesh(rest, subject="rest mesh")
    posed = as_mesh(posed, subject="posed mesh")
    _check_same_topology(rest, posed)
    pairs = rest.face_pairs

    def agreement(mesh: TriangleMesh) -> np.ndarray:
        # Sum over edge neighbours of their area vectors (cross products of two edges, twice the area along the normal).
        around = np.zeros((mesh.face_count, 3))
        for axis in range(3):
            for own, other in ((0, 1), (1, 0)):
                around[:, axis] += np.bincount(
                    pairs[:, own], mesh.face_cross[pairs[:, other], axis], minlength=mesh.face_count
                )
        return np.einsum("ij,ij->i", mesh.face_cross, around)

    return (agreement(rest) > 0) & (agreement(posed) < 0)


def stretch_report(rest: MeshLike, posed: MeshLike, *, limit: float = 3.0) -> StretchReport:
    """Edge stretch and turned faces from `rest` to `posed`.

    Raises:
        InputError: as `edge_stretch`, a limit that is not positive, or no edge with a length.
    """
    rest = as_mesh(rest, subject="rest mesh")
    posed = as_mesh(posed, subject="posed mesh")
    require_positive("stretch limit", limit)
    ratio = edge_stretch(rest, posed)
    known = ratio[np.isfinite(ratio)]
    if not len(known):
        raise InputError("rest mesh", expected="edges with a length", received="none")
    # Percentiles over edges of known length, because the maximum alone may be one sliver.
    p50, p99, p999 = np.percentile(known, (50, 99, 99.9))
    return StretchReport(
        edge_count=len(known),
        degenerate_edges=len(ratio) - len(known),
        p50=float(p50),
        p99=float(p99),
        p999=float(p999),
        max=float(known.max()),
        min=float(known.min()),
        limit=limit,
        flagged_edges=int((known > limit).sum()),
        flipped_faces=int(flipped_faces(rest, posed).sum()),
    )


def _check_same_topology(rest: TriangleMesh, posed: TriangleMesh) -> None:
    if rest.vertex_count != posed.vertex_count or not np.array_equal(rest.faces, posed.faces):
        raise InputError(
            "posed mesh",
            expected=f"the {rest.vertex_count} vertices and {rest.face_count} faces of the rest mesh",
            received=f"{posed.vertex_count} vertices and {posed.face_count} faces, or other indices",
            remedy="pose the same mesh: rest.with_vertices(...)",
        )
    if not rest.face_count:
        raise InputError("rest mesh", expected="faces", received="none")
