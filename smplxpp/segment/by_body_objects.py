"""Find things that a person holds: surface at a hand that no pose of the body and no clothes explain.

Every face has evidence, in square centimetres of surface, that it belongs to a thing: for faces whose nearest part of
the body is a hand it grows with the distance, because cloth does not stand off a hand; on the trunk, legs and head,
where clothes and hair stand off, it is slightly negative. The set O of faces of things minimises

    E(O) = - sum_(i in O) e_i a_i + sum_(cut edges) c_ij length_ij

whose second term is low in concave folds and across edges of colour (`edge_weights`), as where a thing lies against
clothes. A skirt beside a hand has such evidence, too; it goes on smoothly into cloth, so that cutting it out is dear. A
minimum cut gives O; its pieces are kept where they are large enough, touch the hand, and leave its reach.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, TriangleMesh
from smplxpp.core.topology import component_labels, face_adjacency
from smplxpp.segment.by_body_chart import ARM, HAND, HEAD, NECK, TRUNK, chart_of_body
from smplxpp.segment.graph_cut import PottsProblem, minimize_potts
from smplxpp.segment.smoothing import SmoothingConfig, edge_weights

_CM2 = 1e4  # square centimetres in a square metre
# Evidence of faces by their distance, in metres, from the nearest part of the body, interpolated. A fist, or fingers
# that the fit bends otherwise, stand up to 2.5 cm off the fitted hand. What stands farther off an arm is a wide sleeve
# or a thing beside it, which the fold between them tells apart.
_AT_HAND = ((0.012, 0.025, 0.05), (-0.3, 0.0, 1.0))
_AT_ARM = ((0.015, 0.035, 0.06, 0.12), (-1.0, -0.05, 0.02, 0.3))
_ELSEWHERE = ((0.015, 0.05, 0.25, 0.35), (-1.0, -0.05, -0.03, 0.1))
_ON_CHEST = ((0.015, 0.05, 0.09, 0.14), (-1.0, -0.1, 0.0, 0.4))
_ON_HEAD = ((0.0, 1.0), (-0.5, -0.5))
_WAIST = 1.05  # height of the standard person above which no cloth stands far off the trunk, metres
_LENGTH_COST = 2.0  # square centimetres of evidence for one centimetre of a cut through smooth, plain surface


@dataclass(frozen=True, eq=False)
class FoundObjects:
    """Things in hands.

    Attributes:
        faces: the faces of all of them.
        notes: a remark for each.
    """

    faces: Bool[np.ndarray, " M"]
    notes: tuple[str, ...]

    @staticmethod
    def none(count: int) -> FoundObjects:
        """Return no things on a scan of `count` faces."""
        return FoundObjects(np.zeros(count, dtype=bool), ())


def find_objects(
    mesh: TriangleMesh,
    body: BodyModel,
    params: BodyParams,
    *,
    lab: Float64[np.ndarray, "M 3"] | None = None,
) -> FoundObjects:
    """Find the faces of things at the hands of a person.

    Args:
        mesh: the scan, M faces, metres.
        body: the body model.
        params: one frame, in the pose of the scan.
        lab: colours of the faces in OKLab; None: the cut follows folds alone.
    """
    own, posed = chart_of_body(body, params), body.forward(params).vertices[0]
    pairs, ends = face_adjacency(mesh.faces)
    nothing = FoundObjects.none(mesh.face_count)
    hand = own.region == HAND
    if not hand.any():
        return nothing
    # The distance from each face to the body, and the part of it that is nearest, wherever the face looks.
    distance, nearest = cKDTree(posed).query(mesh.face_centers)
    to_hand = cKDTree(posed[hand]).query(mesh.face_centers)[0]
    region = own.region[nearest]
    chest = (region == TRUNK) & (own.height[nearest] > _WAIST)
    evidence = _evidence(distance, region, chest)
    if not (mesh.face_areas[evidence > 0].sum() * _CM2 > _LEAST_AREA):
        return nothing
    # Minimise E by one cut; both terms are in square centimetres, so that finer meshes give the same cut.
    relative = edge_weights(mesh, pairs, ends, SmoothingConfig(smoothness=1.0, floor=0.0, eta_convex=0.0), lab=lab)
    length = 100.0 * np.linalg.norm(np.diff(mesh.vertices[ends], axis=1)[:, 0], axis=1)
    cost = _LENGTH_COST * relative * (length.mean() if len(length) else 1.0)
    unary = np.stack([np.zeros(mesh.face_count), -evidence * mesh.face_areas * _CM2], axis=1)
    unary -= unary.min(axis=1, keepdims=True)
    cut = minimize_potts(PottsProblem.from_costs(unary, pairs, cost))[0].astype(bool)
    hands = [posed[hand & (own.side == side)] for side in (1, -1)]
    middle = posed[own.region == TRUNK].mean(axis=0)
    return _accepted(mesh, cut, pairs, (length, cost), (distance, to_hand, _sectors(mesh, middle)), hands)


_LEAST_AREA = 60.0
"""Square centimetres of a thing; less is a ring, a cuff or the error of a fitted hand."""
_LEAST_REACH = 0.06
"""Metres by which a thing leaves the body; fists and wrong fingers stay within."""
_TOUCHES = 0.03
"""Metres from the hand within which a thing begins."""
_SHOWS, _SHOWN = 0.015, 0.4
"""Metres within which the scan shows a point of a hand, and the share of a hand that it has to show beside a thing."""
_LARGER_THAN_HANDS = 900.0
"""Square centimetres from which a piece is a thing, although the scan does not show the hand where the body has it."""
_SMOOTH_BORDER = 0.6
"""Mean cost of the cut, as a share of that through smooth and plain surface, from which it is no border of a thing."""


_SECTORS, _ALL_ROUND = 12, 9
"""Sectors of 30 degrees about the person, and the number of them from which a piece goes round her, as skirts do."""


def _sectors(mesh: TriangleMesh, middle: Float64[np.ndarray, " 3"]) -> Int64[np.ndarray, " M"]:
    """Return the sector of each face about the vertical axis through `middle`."""
    x, _, z = (mesh.face_centers - middle).T
    return np.floor((np.arctan2(x, z) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(np.int64) % _SECTORS


def _evidence(distance: np.ndarray, region: np.ndarray, chest: np.ndarray) -> Float64[np.ndarray, " M"]:
    """Return the evidence of each face that it belongs to a thing, a square centimetre for each of its own."""
    out = np.interp(distance, *_ELSEWHERE)
    head = np.isin(region, (HEAD, NECK))
    for where, curve in ((region == HAND, _AT_HAND), (region == ARM, _AT_ARM), (chest, _ON_CHEST), (head, _ON_HEAD)):
        out[where] = np.interp(distance[where], *curve)
    return out


def _accepted(
    mesh: TriangleMesh,
    cut: Bool[np.ndarray, " M"],
    pairs: Int64[np.ndarray, "P 2"],
    edges: tuple[np.ndarray, np.ndarray],
    where: tuple[np.ndarray, np.ndarray, np.ndarray],
    hands: list[np.ndarray],
) -> FoundObjects:
    """Keep the pieces of a cut that are things.

    Args:
        mesh: the scan.
        cut: faces on the side of things.
        pairs: the two faces of each edge.
        edges: length, in centimetres, and cost of each edge.
        where: distance of each face to the body and to its hands, metres, and its sector about the person.
        hands: points of either hand of the body.
    """
    distance, to_hand, sector = where
    # A hand that what is left of the scan does not show lies elsewhere: then a small piece is the hand itself.
    left = cKDTree(mesh.face_centers[~cut]) if not cut.all() else None
    shown = [bool(left and len(h) and (left.query(h)[0] < _SHOWS).mean() > _SHOWN) for h in hands]
    length, cost = edges
    inside = cut[pairs]
    piece = component_labels(pairs[inside.all(axis=1)], len(cut))
    faces, notes = np.zeros(len(cut), dtype=bool), []
    for number in np.unique(piece[cut]):
        own = cut & (piece == number)
        area = float(mesh.face_areas[own].sum()) * _CM2
        if area < _LEAST_AREA or distance[own].max() < _LEAST_REACH or to_hand[own].min() > _TOUCHES:
            continue
        # Clothes that hang far off the legs go round the person; a thing is on one side of her.
        around = np.bincount(sector[own], mesh.face_areas[own], minlength=_SECTORS) * _CM2 / area
        if (around > 0.02).sum() >= _ALL_ROUND:
            continue
        center = mesh.face_centers[own][to_hand[own].argmin()]
        nearest = int(np.argmin([np.linalg.norm(h - center, axis=1).min() if len(h) else np.inf for h in hands]))
        if not shown[nearest] and area < _LARGER_THAN_HANDS:
            continue
        # The cost of its border, relative to a border of the same length through smooth and plain surface.
        border = own[pairs[:, 0]] != own[pairs[:, 1]]
        plain = _LENGTH_COST * length[border].sum()
        if plain > 0 and cost[border].sum() > _SMOOTH_BORDER * plain:
            continue
        faces |= own
        notes.append(f"a thing of {area:.0f} cm2 at a hand is labelled object")
    return FoundObjects(faces, tuple(notes))
