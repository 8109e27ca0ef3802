"""Find where the upper garment ends over the lower one where colours do not show it, by a cut along folds.

A jacket that is open ends at its hem at the back and at a waistband in front, and no ring about the body follows that.
About the waist, faces have no label of their own; above and below they are upper and lower. The border is the shortest
cut between them, in the weights of the graph cut of all labels, which make hems, lips of cloth and waistbands short. It
is taken where the surface speaks for it: where it is much shorter than the same edges would be without folds. Where it
is hardly shorter, there is no border: a dress, a jumpsuit, overalls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.core import TriangleMesh
from smplxpp.segment.by_body_chart import LEG, TRUNK, BodyChart
from smplxpp.segment.by_body_outfit import Outfit
from smplxpp.segment.graph_cut import PottsProblem, SmoothingConfig, edge_weights, minimize_potts

_LOW, _HIGH, _BESIDE = 0.74, 1.06, 0.06
"""Heights between which hems of shirts and jackets lie, standard metres, and how far beside the outline's border."""
_FOLDED = 0.55
_SEAMLESS = 0.62
"""Length of the border with its folds, as a share of its length without, up to which the surface speaks for it: each of
45 procedural people has it where the others are right most often. From `_SEAMLESS` on it speaks for one garment: 41
people in two have at most 0.57, one 0.75; of six in dresses, jumpsuits and overalls five have 0.66 to 0.78 and one,
whose hair ends at the waist, 0.45."""
_FIXED = 1e4
"""Cost of another label above and below, more than any cut."""


@dataclass(frozen=True, eq=False)
class Waist:
    """The border of the upper garment over the lower one.

    Attributes:
        faces: those whose label it decides.
        upper: whether a face lies above it.
        away: distance of each face to it, metres.
        folded: its length with folds as a share of that without.
        height: of its middle, standard metres.
        top: height above which it cannot lie, standard metres.
    """

    faces: Bool[np.ndarray, " M"]
    upper: Bool[np.ndarray, " M"]
    away: Float64[np.ndarray, " M"]
    folded: float
    height: float
    top: float

    @property
    def shown(self) -> bool:
        """Return whether the surface shows the border."""
        return self.folded <= _FOLDED

    @property
    def seamless(self) -> bool:
        """Return whether the best border hardly follows folds, as across one garment."""
        return self.folded > _SEAMLESS


def find_waist(
    mesh: TriangleMesh,
    chart: BodyChart,
    outfit: Outfit,
    pairs: Int64[np.ndarray, "P 2"],
    ends: Int64[np.ndarray, "P 2"],
    *,
    used: Bool[np.ndarray, " M"],
    smoothing: SmoothingConfig,
) -> Waist | None:
    """Return the shortest border between upper and lower garment, None where there are not both.

    Args:
        mesh: the scan.
        chart: places of its faces.
        outfit: outline of the clothes.
        pairs: faces that share an edge.
        ends: the vertices of these edges.
        used: faces of clothes, without things in hands.
        smoothing: weights of edges.
    """
    if not outfit.has_lower or outfit.upper_start > outfit.lower_end + 1e-9:
        return None
    low, high = min(_LOW, outfit.lower_end - _BESIDE), max(_HIGH, outfit.lower_end + _BESIDE)
    # Two labels on trunk and legs, fixed above and below.
    part = np.flatnonzero(np.isin(chart.region, (TRUNK, LEG)) & used)
    place = chart.height[part]
    index = np.full(mesh.face_count, -1)
    index[part] = np.arange(len(part))
    within = (index[pairs] >= 0).all(axis=1)
    own, edge = index[pairs[within]], ends[within]
    weights = edge_weights(mesh, pairs, ends, smoothing)[within]
    cost = np.stack([np.where(place < low, _FIXED, 0.0), np.where(place > high, _FIXED, 0.0)], axis=1)
    upper, _ = minimize_potts(
        PottsProblem.from_costs(cost, own, weights), labels=(place <= outfit.lower_end).astype(np.int64)
    )
    upper = upper == 0
    crossed = upper[own[:, 0]] != upper[own[:, 1]]
    if not crossed.any():
        return None
    # What the border would cost if no edge were folded.
    flat = SmoothingConfig(
        smoothness=smoothing.smoothness, floor=smoothing.floor, eta_convex=0.0, eta_concave=0.0, fold=smoothing.fold
    )
    folded = float(weights[crossed].sum() / edge_weights(mesh, pairs, ends, flat)[within][crossed].sum())
    border = mesh.vertices[edge[crossed]].mean(axis=1)
    faces, above, away = np.zeros(mesh.face_count, bool), np.zeros(mesh.face_count, bool), np.zeros(mesh.face_count)
    faces[part], above[part] = (place > low) & (place < high), upper
    away[part] = cKDTree(border).query(mesh.face_centers[part])[0]
    height = float(np.median(place[own[crossed]]))
    return Waist(faces, above, away, folded, height, high)


def one_or_two(
    mesh: TriangleMesh,
    chart: BodyChart,
    outfit: Outfit,
    pairs: Int64[np.ndarray, "P 2"],
    ends: Int64[np.ndarray, "P 2"],
    *,
    used: Bool[np.ndarray, " M"],
    smoothing: SmoothingConfig,
) -> tuple[Outfit, Waist | None]:
    """Ask the surface whether one garment over trunk and legs is one, as a dress, or two of one cloth.

    Of nine people and scans in one garment for the outline, four are dressed in two: they have 0.2 to 0.49 of the
    border's length, the dresses and the jumpsuit 0.67 to 0.79. Arguments as of `find_waist`.

    Returns:
        The outline in two and their border where the surface shows one above the hem; else the outline, whose
        `seamless` says whether the surface speaks for one garment, and None.
    """
    waist = find_waist(mesh, chart, outfit.in_two(), pairs, ends, used=used, smoothing=smoothing)
    if waist is not None and waist.shown and waist.height > outfit.upper_start + _BESIDE:
        return outfit.in_two(), waist
    return (outfit.as_one_piece() if waist is not None and waist.seamless else outfit), None
