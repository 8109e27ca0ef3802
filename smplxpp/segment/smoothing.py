"""What keeps labels together along a surface: costs of a change across edges, islands given to what is around."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, Num

from smplxpp.core.colors import linear_from_srgb, oklab_from_linear
from smplxpp.core.errors import InputError
from smplxpp.core.labels import LABELS, SKIN
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.topology import component_labels

# Steps of lightness and of the two axes of colour that weigh the same: light and noise change lightness most.
COLOR_STEP = np.array([0.055, 0.022, 0.022])


@dataclass(frozen=True)
class SmoothingConfig:
    """Costs of label changes, and which patches are too small.

    Attributes:
        smoothness: factor of the pairwise cost. floor: its least value at any edge.
        eta_convex, eta_concave: how much a fold lowers the cost of a label change there.
        fold: cosine deficit that counts as a fold.
        least_contrast: what is left of the cost across the strongest edges of colour, where colours are given.
        speck_area: patches below this fraction of the surface's area take their surroundings' label.
        island_area: patches of anything worn do so below this fraction: a label map that is wrong beside a border
            leaves a bit of skirt on the fingers, and nothing worn is that small (57 of 19,000 square centimetres).
        doubtful_area, doubtful: so does a patch of any label below this fraction whose mean confidence is lower.
    """

    smoothness: float = 1.2
    floor: float = 0.05
    eta_convex: float = 0.15
    eta_concave: float = 1.0
    fold: float = 0.1
    least_contrast: float = 0.1
    speck_area: float = 1e-4
    island_area: float = 3e-3
    doubtful_area: float = 5e-3
    doubtful: float = 0.7


def face_colors(mesh: TriangleMesh, colors: Num[np.ndarray, "N C"]) -> Float64[np.ndarray, "M 3"]:
    """The mean OKLab colour of each face's corners.

    Args:
        colors: sRGB of the vertices, bytes or 0..1, with or without opacity.

    Raises:
        InputError: another number of vertices, or values out of range.
    """
    colors = np.asarray(colors)
    if colors.ndim != 2 or len(colors) != mesh.vertex_count or colors.shape[1] not in (3, 4):
        raise InputError("vertex colours", expected=f"shape ({mesh.vertex_count}, 3)", received=f"shape {colors.shape}")
    colors = colors[:, :3]
    fits = colors.dtype == np.uint8
    if colors.dtype.kind == "f" and colors.size:
        fits = bool(np.isfinite(colors).all() and colors.min() >= 0 and colors.max() <= 1)
    if not fits:
        raise InputError(
            "vertex colours",
            expected="bytes, or numbers from 0 to 1",
            received=f"{colors.dtype}, or values out of range",
        )
    return oklab_from_linear(linear_from_srgb(colors))[mesh.faces].mean(axis=1)


def likeness(lab: Float64[np.ndarray, "M 3"], pairs: Int64[np.ndarray, "P 2"]) -> Float64[np.ndarray, " P"]:
    """1 where two faces have one colour, down to 0 where they differ far more than neighbours do on average.

    `exp(-d^2 / (2 mean d^2))` (Rother et al., GrabCut, 2004), d the difference in steps of `COLOR_STEP`.
    """
    squared = (((lab[pairs[:, 0]] - lab[pairs[:, 1]]) / COLOR_STEP) ** 2).sum(axis=1)
    mean = float(squared.mean()) if len(squared) else 0.0
    return np.exp(-squared / (2.0 * max(mean, 1e-9)))


def edge_weights(
    mesh: TriangleMesh,
    pairs: Int64[np.ndarray, "P 2"],
    ends: Int64[np.ndarray, "P 2"],
    config: SmoothingConfig,
    *,
    lab: Float64[np.ndarray, "M 3"] | None = None,
) -> Float64[np.ndarray, " P"]:
    """The cost of a label change across each edge: low in folds, above all in concave ones, and across edges of colour.

    Args:
        pairs, ends: faces and vertices of the edges (`face_adjacency`). lab: colours of the faces (`face_colors`).
    """
    length = np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1)
    normal = mesh.face_normals
    n0, n1 = normal[pairs[:, 0]], normal[pairs[:, 1]]
    deficit = 1.0 - np.einsum("ij,ij->i", n0, n1)
    middle = mesh.triangles.mean(axis=1)
    # Concave: the neighbour lies on the side that the normal points to.
    concave = np.einsum("ij,ij->i", middle[pairs[:, 1]] - middle[pairs[:, 0]], n0 - n1) > 0
    eta = np.where(concave, config.eta_concave, config.eta_convex)
    mean = length.mean() if len(length) else 1.0
    weights = config.smoothness * length / mean * np.exp(-eta * deficit / config.fold) + config.floor
    if lab is None:
        return weights
    return weights * (config.least_contrast + (1.0 - config.least_contrast) * likeness(lab, pairs))


def absorb_islands(
    mesh: TriangleMesh,
    labels: Int64[np.ndarray, " M"],
    confidence: Float64[np.ndarray, " M"],
    pairs: Int64[np.ndarray, "P 2"],
    ends: Int64[np.ndarray, "P 2"],
    config: SmoothingConfig,
) -> Int64[np.ndarray, " M"]:
    """Give patches that are too small for their label the one that they share the longest border with.

    Only patches that are large enough hand on their label; a small one that touches none of them stays.
    """
    same = labels[pairs[:, 0]] == labels[pairs[:, 1]]
    patch = component_labels(pairs[same], len(labels))
    area = np.bincount(patch, mesh.face_areas)
    label_of_patch = np.empty(len(area), dtype=np.int64)
    label_of_patch[patch] = labels
    doubtful = np.bincount(patch, mesh.face_areas * confidence) < config.doubtful * area
    least = np.where(label_of_patch == SKIN.id, config.speck_area, config.island_area)
    least = np.where(doubtful, np.maximum(least, config.doubtful_area), least)
    small = area < least * area.sum()
    if not small.any():
        return labels
    crossing = pairs[~same]
    length = np.linalg.norm(np.diff(mesh.vertices[ends[~same]], axis=1)[:, 0], axis=1)
    here = np.concatenate([patch[crossing[:, 0]], patch[crossing[:, 1]]])
    there = np.concatenate([patch[crossing[:, 1]], patch[crossing[:, 0]]])
    usable = small[here] & ~small[there]
    border = np.zeros((len(area), len(LABELS)))
    np.add.at(border, (here[usable], label_of_patch[there[usable]]), np.concatenate([length, length])[usable])
    absorbed = border.any(axis=1)
    label_of_patch[absorbed] = border[absorbed].argmax(axis=1)
    return label_of_patch[patch]
