"""Smooth labels along a surface: pairwise costs of label changes across edges, and removal of small patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, Num

from smplxpp.core import LABELS, SKIN, InputError, Labels, TriangleMesh
from smplxpp.core.colors import linear_from_srgb, oklab_from_linear
from smplxpp.core.topology import component_labels

COLOR_STEP = np.array([0.055, 0.022, 0.022])
"""Scale of OKLab differences (L, a, b). Light and noise change lightness most, so that it weighs least."""


@dataclass(frozen=True)
class SmoothingConfig:
    """Costs of label changes, and bounds below which a patch is too small.

    Attributes:
        smoothness: factor of the pairwise cost.
        floor: lower bound of the pairwise cost at any edge.
        eta_convex: how much a convex fold lowers the cost of a label change.
        eta_concave: the same for a concave fold.
        fold: scale of 1 - cos(dihedral angle) in the pairwise cost.
        least_contrast: factor of the cost across the strongest edges of colour, if colours are given.
        speck_area: area fraction of the surface below which a patch of skin is relabelled.
        island_area: the same for patches of garments, hair and shoes. Parsers leave such fragments near label borders
            (a bit of skirt on the fingers); nothing worn is smaller than 57 of 19,000 square centimetres.
        uncertain_area: the same for patches of any label with a mean confidence below `uncertain`.
        uncertain: mean confidence below which a patch is uncertain.
    """

    smoothness: float = 1.2
    floor: float = 0.05
    eta_convex: float = 0.15
    eta_concave: float = 1.0
    fold: float = 0.1
    least_contrast: float = 0.1
    speck_area: float = 1e-4
    island_area: float = 3e-3
    uncertain_area: float = 5e-3
    uncertain: float = 0.7


def face_colors(mesh: TriangleMesh, colors: Num[np.ndarray, "N C"]) -> Float64[np.ndarray, "M 3"]:
    """Return the mean OKLab colour of each face's corners.

    Args:
        mesh: the mesh.
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
    """Return the similarity of neighbours' colours: 1 for equal colours, near 0 for far more than the mean difference.

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
    """Return the cost of a label change across each edge; it is low at folds and across edges of colour.

    Args:
        mesh: the mesh.
        pairs: the two faces of each edge (`face_adjacency`).
        ends: the two vertices of each edge.
        config: weights.
        lab: colours of the faces (`face_colors`).
    """
    # w = smoothness (length / mean) exp(-eta (1 - cos dihedral) / fold) + floor, times the contrast of colours.
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
    face_labels: Int64[np.ndarray, " M"],
    confidence: Float64[np.ndarray, " M"],
    pairs: Int64[np.ndarray, "P 2"],
    ends: Int64[np.ndarray, "P 2"],
    config: SmoothingConfig,
    *,
    labels: Labels = LABELS,
) -> Int64[np.ndarray, " M"]:
    """Relabel patches that are too small to the label with which they share the longest border.

    Only patches that are large enough pass on their label; a small patch that touches none of them keeps its own. A
    user's own labels of small things (`Labels.small`) have the bound of skin, because glasses are no fragment.
    """
    # Patches are connected faces of one label; the least area depends on the label and the mean confidence.
    same = face_labels[pairs[:, 0]] == face_labels[pairs[:, 1]]
    patch = component_labels(pairs[same], len(face_labels))
    area = np.bincount(patch, mesh.face_areas)
    label_of_patch = np.empty(len(area), dtype=np.int64)
    label_of_patch[patch] = face_labels
    uncertain = np.bincount(patch, mesh.face_areas * confidence) < config.uncertain * area
    things = labels.small[label_of_patch]
    least = np.where(things | (label_of_patch == SKIN.id), config.speck_area, config.island_area)
    least = np.where(uncertain & ~things, np.maximum(least, config.uncertain_area), least)
    small = area < least * area.sum()
    if not small.any():
        return face_labels
    # Lengths of the borders between each small patch and the labels of large patches around it.
    crossing = pairs[~same]
    length = np.linalg.norm(np.diff(mesh.vertices[ends[~same]], axis=1)[:, 0], axis=1)
    here = np.concatenate([patch[crossing[:, 0]], patch[crossing[:, 1]]])
    there = np.concatenate([patch[crossing[:, 1]], patch[crossing[:, 0]]])
    usable = small[here] & ~small[there]
    border = np.zeros((len(area), len(labels)))
    np.add.at(border, (here[usable], label_of_patch[there[usable]]), np.concatenate([length, length])[usable])
    absorbed = border.any(axis=1)
    label_of_patch[absorbed] = border[absorbed].argmax(axis=1)
    return label_of_patch[patch]
