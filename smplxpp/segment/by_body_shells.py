"""Label modelled characters as scans are: split long faces, and keep each garment to the shells that it has.

A character's faces are as long as its shins, so that most rings of the body have no centre of a face, and one label
holds from ankle to knee. On the other hand each of its garments is modelled as a surface of its own, which a scan's are
not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float64, Int64, Num

from smplxpp.core import LOWER, OUTER, SHOE, UPPER, TriangleMesh, row_lengths
from smplxpp.core.labels import LABELS
from smplxpp.core.topology import face_components, split_faces
from smplxpp.segment.by_body_chart import HIP
from smplxpp.segment.by_body_rings import STEP
from smplxpp.segment.segment import SegmentedScan

_GARMENTS = (SHOE.id, UPPER.id, LOWER.id, OUTER.id)


def split_long_faces(
    mesh: TriangleMesh, colors: Num[np.ndarray, "N C"]
) -> tuple[TriangleMesh, Num[np.ndarray, "n C"], Int64[np.ndarray, " m"]]:
    """Halve the edges of a coarse character until each is at most three rings of `by_body_rings` long.

    A mesh is one where no shell has more than six tenths of the surface, as that of a scan has, and faces longer than
    six rings cover a tenth of it: then rings have none. A vertex in the middle of an edge has the mean colour of its
    ends. The order of faces changes. A surface of more than 20 square metres, ten people's skin, is in other units or
    mostly no person: it is left as it is.

    Returns:
        The split mesh, its colours, and for each of its faces the face of `mesh` that it is a part of.
    """
    area, whole = mesh.face_areas, np.arange(mesh.face_count)
    sides = row_lengths((mesh.triangles - np.roll(mesh.triangles, 1, axis=1)).reshape(-1, 3)).reshape(-1, 3)
    coarse = area @ (sides.max(axis=1) > 6.0 * STEP) > 0.1 * area.sum() and area.sum() < 20.0
    if not coarse or np.bincount(face_components(mesh.faces), area).max() > 0.6 * area.sum():
        return mesh, colors, whole
    # Six rounds split what is as long as a person.
    for _ in range(6):
        edges = mesh.edges
        ends = edges[row_lengths(mesh.vertices[edges[:, 1]] - mesh.vertices[edges[:, 0]]) > 3.0 * STEP]
        if not len(ends):
            break
        faces, part = split_faces(mesh.faces, ends, mesh.vertex_count)
        mesh = TriangleMesh(np.concatenate([mesh.vertices, mesh.vertices[ends].mean(axis=1)]), faces)
        mean = colors[ends].mean(axis=1)
        mean = np.rint(mean) if np.issubdtype(colors.dtype, np.integer) else mean
        colors, whole = np.concatenate([colors, mean.astype(colors.dtype)]), whole[part]
    return mesh, colors, whole


def of_whole_faces(
    found: SegmentedScan, area: Float64[np.ndarray, " m"], whole: Int64[np.ndarray, " m"], seen: Bool[np.ndarray, " M"]
) -> SegmentedScan:
    """Return the labels of faces from those of their parts: the label of most of a face's area, with its confidence.

    Args:
        found: labels of the parts.
        area: areas of the parts.
        whole: the face of each part.
        seen: whether each face is seen from outside.
    """
    shares = np.zeros((len(seen), len(LABELS)))
    np.add.at(shares, (whole, found.face_labels), area)
    labels = shares.argmax(axis=1)
    own = found.face_labels == labels[whole]
    sure = np.bincount(whole[own], (area * found.confidence)[own], minlength=len(seen))
    most = np.bincount(whole[own], area[own], minlength=len(seen))
    confidence = np.divide(sure, most, out=np.zeros(len(seen)), where=most > 0)
    return replace(found, face_labels=labels, confidence=confidence, seen=seen)


def garment_shells(
    mesh: TriangleMesh,
    labels: Int64[np.ndarray, " M"],
    confidence: Float64[np.ndarray, " M"],
    height: Float64[np.ndarray, " M"],
) -> tuple[Int64[np.ndarray, " M"], Float64[np.ndarray, " M"]]:
    """Return labels in which what runs over from one garment's shell into another's has that one's label.

    A garment that has shells elsewhere, with more of its area than here, and covers less than half as much of this
    shell as its main garment does, ends there. Where shells below the hips are shoes, with two hundredths of the
    surface, none that reaches the hips is one. So trousers do not end in shoes because these have the same colour,
    while a figure in one piece keeps all of its clothes, as does a scan.

    Args:
        mesh: the surface.
        labels: of its faces.
        confidence: of the labels.
        height: of the faces along the body (`BodyChart.height`).
    """
    shell = face_components(mesh.faces)
    count = int(shell.max()) + 1
    top = np.full(count, -np.inf)
    np.maximum.at(top, shell, height)
    labels, confidence = labels.copy(), confidence.copy()
    # What is moved makes its garment's shells larger, so that more of it may be moved: twice is once for each end.
    for _ in range(2):
        worn = np.zeros((count, len(LABELS)))
        np.add.at(worn, (shell, labels), mesh.face_areas)
        main, over = _running_over(worn[:, _GARMENTS], top >= HIP, least=0.02 * mesh.face_areas.sum())
        for k, label in enumerate(_GARMENTS):
            moved = (labels == label) & over[shell, k]
            for s in np.unique(shell[moved]):
                own, kept = moved & (shell == s), (shell == s) & (labels == _GARMENTS[main[s]])
                labels[own] = _GARMENTS[main[s]]
                confidence[own] = np.average(confidence[kept], weights=np.maximum(mesh.face_areas[kept], 1e-12))
    return labels, confidence


def _running_over(
    worn: Float64[np.ndarray, "S G"], high: Bool[np.ndarray, " S"], *, least: float
) -> tuple[Int64[np.ndarray, " S"], Bool[np.ndarray, "S G"]]:
    """Return the main garment of each shell, and which of its others end there, by their areas; shoes come first.

    Args:
        worn: area of each garment in each shell.
        high: whether a shell reaches the hips.
        least: area of the shoes below the hips from which on higher shells are none.
    """
    shoe = np.arange(worn.shape[1]) == 0
    low = (worn.argmax(axis=1) == 0) & ~high
    no_shoe = high & (worn[low, 0].sum() > least) & (worn[:, ~shoe].max(axis=1) > 0)
    likely = np.where(no_shoe[:, None] & shoe, 0.0, worn)
    main = likely.argmax(axis=1)
    # The area of each garment in all shells whose main one it is: shoes are two.
    home = np.bincount(main, likely.max(axis=1), minlength=worn.shape[1])
    return main, (likely < home) & (likely < 0.5 * likely.max(axis=1, keepdims=True))
