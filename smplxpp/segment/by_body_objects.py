"""Find things that a person holds or wears on a strap: surface that no pose of the body and no clothes explain.

Every face has evidence, in square centimetres of surface, that it belongs to a thing. Evidence grows with the
distance of faces whose nearest part of the body is a hand, because cloth does not stand off a hand; boards
(`flat_share`) have it beside an arm and on the chest, because sleeves and shirts are nowhere flat over 10 cm; on the
rest of trunk, legs and head, where clothes and hair stand off, it is slightly negative. The set O of faces of things
minimises

    E(O) = - sum_(i in O) e_i a_i + sum_(cut edges) c_ij length_ij

whose second term is low in concave folds and across edges of colour (`edge_weights`), as where a thing lies against
clothes or an arm. A skirt beside a hand has such evidence, too; it continues smoothly into cloth, so that cutting it
out is dear. Bags have evidence where they stand off trunk and legs and the mirrored place of the other side is empty,
because clothes hang off both. A minimum cut gives O; its pieces are kept where they are large enough, touch a hand or
are lacking on the other side, leave the reach of clothes, and have a border that is short for their area, which a flap
of cloth does not have. With colours, a second cut adds what has the colour of a piece at the hand that holds it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, TriangleMesh
from smplxpp.core.topology import component_labels, face_adjacency
from smplxpp.segment.by_body_chart import ARM, HAND, HEAD, LEG, NECK, TRUNK, chart_of_body, chart_of_scan
from smplxpp.segment.flat_patches import flat_share
from smplxpp.segment.graph_cut import PottsProblem, SmoothingConfig, edge_weights, minimize_potts

_CM2 = 1e4  # square centimetres in a square metre
# Evidence of faces by their distance, in metres, from the nearest part of the body, interpolated. A fist, or fingers
# that the fit bends otherwise, stand up to 2.5 cm off the fitted hand. What stands farther off an arm is a wide sleeve
# or a thing beside it, which the fold between them tells apart.
_AT_HAND = ((0.012, 0.025, 0.05), (-0.3, 0.0, 1.0))
_AT_ARM = ((0.015, 0.035, 0.06, 0.12), (-1.0, -0.05, 0.02, 0.3))
_ELSEWHERE = ((0.015, 0.05, 0.25, 0.35), (-1.0, -0.05, -0.03, 0.1))
_ON_CHEST = ((0.015, 0.05, 0.09, 0.14), (-1.0, -0.1, 0.0, 0.4))
_ON_HEAD = ((0.0, 1.0), (-0.5, -0.5))
# Evidence of a board, which an arm may press against the chest; a shirt that lies on the chest may be flat.
_BOARD, _BOARD_ON_CHEST = 0.3, ((0.02, 0.04), (0.0, 1.0))
_BOARD_REACH = 0.6
"""Metres from a hand within which boards are looked for, the diagonal of a large folder."""
_LOOKS_OUT = 0.5
"""Cosine between the normals of a shirt or skirt and of the trunk and legs that it hangs off."""
# Evidence of surface off trunk and legs that the other side of the person lacks, by its distance from the body, metres.
_WORN = (0.015, 0.04, 0.10), (-1.0, 0.0, 0.6)
_LENGTH_COST = 2.0  # square centimetres of evidence for one centimetre of a cut through smooth, plain surface


@dataclass(frozen=True, eq=False)
class FoundObjects:
    """Things that a person holds or wears.

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

    def joined(self, other: FoundObjects) -> FoundObjects:
        """Return the things of both."""
        return FoundObjects(self.faces | other.faces, (*self.notes, *other.notes))


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
    own, posed = chart_of_body(body, params), body.mesh(body.forward(params).vertices[0])
    hand = own.region == HAND
    if not hand.any():
        return FoundObjects.none(mesh.face_count)
    # The distance from each face to the body, and the part of it that is nearest, wherever the face looks.
    distance, nearest = cKDTree(posed.vertices).query(mesh.face_centers)
    region = own.region[nearest]
    # Height of the standard person above which no cloth stands far off the trunk, metres.
    waist = 1.05
    chest = (region == TRUNK) & (own.height[nearest] > waist)
    evidence = _evidence(distance, region, chest)
    # Below a hand clothes hang off the trunk: they face where it faces there.
    clothed = np.isin(own.region, (TRUNK, LEG))
    off, at = cKDTree(posed.vertices[clothed]).query(mesh.face_centers)
    looks = np.einsum("ij,ij->i", mesh.face_normals, posed.vertex_normals[clothed][at])
    reach = 0.09  # metres within which a shirt or skirt hangs off them
    hangs = (region == HAND) & (off < reach) & (looks > _LOOKS_OUT)
    evidence[hangs] = np.minimum(evidence[hangs], 0.0)
    lacked = np.zeros(mesh.face_count)
    beside = np.flatnonzero(np.isin(region, (TRUNK, LEG)) & (distance > _WORN[0][0]))
    if len(beside):
        away = _from_mirrored(mesh, body, params, posed, beside, np.flatnonzero(clothed)[at[beside]])
        # By how far the scan is from the mirrored place, metres.
        lacked[beside] = np.interp(away, (0.03, 0.06), (0.0, 1.0))
        worn = (1.0 + np.interp(distance[beside], *_WORN)) * lacked[beside] - 1.0
        evidence[beside] = np.maximum(evidence[beside], worn)
        # Cloth looks away from the body: what looks at it may be the back of a thing, and is nearly free.
        backs = beside[looks[beside] < -_LOOKS_OUT]
        evidence[backs] = np.maximum(evidence[backs], -0.02)
    if not (mesh.face_areas[evidence > 0].sum() * _CM2 > _LEAST_AREA):
        return FoundObjects.none(mesh.face_count)
    # Boards at an arm or on the chest, from both sides.
    to_hand = cKDTree(posed.vertices[hand]).query(mesh.face_centers)[0]
    flat = flat_share(mesh, to_hand < _BOARD_REACH)
    beside = np.where(chest, np.interp(distance, *_BOARD_ON_CHEST), np.isin(region, (ARM, HAND)))
    evidence = np.maximum(evidence, (1.0 + _BOARD) * flat * beside - 1.0)
    # Minimise E by one cut; both terms are in square centimetres, so that finer meshes give the same cut.
    pairs, ends = face_adjacency(mesh.faces)
    relative = edge_weights(mesh, pairs, ends, SmoothingConfig(smoothness=1.0, floor=0.0, eta_convex=0.0), lab=lab)
    length = 100.0 * np.linalg.norm(np.diff(mesh.vertices[ends], axis=1)[:, 0], axis=1)
    cost = _LENGTH_COST * relative * (length.mean() if len(length) else 1.0)
    charted, middle = chart_of_scan(mesh, body, params), posed.vertices[own.region == TRUNK].mean(axis=0)
    where = _Where(distance, to_hand, _sectors(mesh, middle), flat, lacked, pairs, length, cost)

    def things_by(evidence: Float64[np.ndarray, " M"], known: Bool[np.ndarray, " M"]) -> FoundObjects:
        unary = np.stack([np.zeros(mesh.face_count), -evidence * mesh.face_areas * _CM2], axis=1)
        unary -= unary.min(axis=1, keepdims=True)
        cut = minimize_potts(PottsProblem.from_costs(unary, pairs, cost))[0].astype(bool)
        # What is left of either hand, where a face takes the part of the body that faces alike.
        left = (charted.region == HAND) & ~cut
        hands = [
            (
                posed.vertices[hand & (own.side == one)],
                float(mesh.face_areas[left & (charted.side == one)].sum()) * _CM2,
            )
            for one in (1, -1)
        ]
        paired = np.zeros(mesh.face_count)
        found = _accepted(mesh, cut, where, hands, paired=paired, known=known)
        # A wide sleeve has its like at the other arm, which is no thing; of two things in two hands both are found.
        arms = np.flatnonzero(found.faces & np.isin(region, (ARM, HAND)) & (distance > 0.03))
        if len(arms):
            away = _from_mirrored(mesh, body, params, posed, arms, nearest[arms], among=~found.faces)
            paired[arms] = away < 0.4 * distance[arms]
            found = _accepted(mesh, cut, where, hands, paired=paired, known=known)
        return found

    found = things_by(evidence, np.zeros(mesh.face_count, dtype=bool))
    if lab is None or not found.faces.any():
        return found
    # Fitted fingers reach into a thing, whose other end then has no evidence but the colour of the end that was found.
    for one in (1, -1):
        at = (region == HAND) & (own.side[nearest] == one)
        if (found.faces & at).any():
            # Skin and sleeves within a forearm, metres, of the hands, not hair, which may be as brown as a bottle.
            person = ~found.faces & ~at & (to_hand < 0.3)
            alike = _alike(lab, found.faces, person, at & ~hangs)
            evidence = np.maximum(evidence, (1.0 + _BOARD) * alike - 1.0)
    more = things_by(evidence, found.faces)
    return found if (found.faces & ~more.faces).any() else more


def _alike(
    lab: Float64[np.ndarray, "M 3"],
    thing: Bool[np.ndarray, " M"],
    person: Bool[np.ndarray, " M"],
    faces: Bool[np.ndarray, " M"],
) -> Float64[np.ndarray, " M"]:
    """Return how surely some faces have the colours of a thing and none of the person's, 0 to 1."""
    out = np.zeros(len(lab))
    near = 10  # by the tenth nearest colour, because a few faces of either are wrong
    if min(thing.sum(), person.sum()) > near and faces.any():
        a, b = (cKDTree(lab[group]).query(lab[faces], k=near)[0][:, -1] for group in (thing, person))
        # Differences of 0.02 in OKLab are just seen; where both have the colour, the share is 0.5.
        out[faces] = np.interp((b + 0.02) / (a + b + 0.04), (0.6, 0.75), (0.0, 1.0))
    return out


def _from_mirrored(
    mesh: TriangleMesh,
    body: BodyModel,
    params: BodyParams,
    posed: TriangleMesh,
    faces: Int64[np.ndarray, " F"],
    vertex: Int64[np.ndarray, " F"],
    *,
    among: Bool[np.ndarray, " M"] | None = None,
) -> Float64[np.ndarray, " F"]:
    """Return how far a scan is from where some of its faces would be on the other side of the person, metres.

    The offset of a face from its vertex of the body is mirrored in the frame of the joint that the vertex follows, so
    that a pose with one leg forward is none of the difference.

    Args:
        mesh: the scan.
        body: the model.
        params: one frame, in the pose of the scan.
        posed: the body.
        faces: some faces.
        vertex: for each of them the vertex of the body.
        among: the faces of the scan that count; None: all.
    """
    flip = np.array([-1.0, 1.0, 1.0])
    other = cKDTree(body.v_template).query(body.v_template[vertex] * flip)[1]
    joint = np.asarray(body.weights).argmax(axis=1)
    turn = body.forward(params).posed_from_rest[0][:, :3, :3]
    offset = np.einsum("nji,nj->ni", turn[joint[vertex]], mesh.face_centers[faces] - posed.vertices[vertex])
    place = posed.vertices[other] + np.einsum("nij,nj->ni", turn[joint[other]], offset * flip)
    return cKDTree(mesh.face_centers if among is None else mesh.face_centers[among]).query(place)[0]


@dataclass(frozen=True, eq=False)
class _Where:
    """Measures of faces and edges that judge the pieces of a cut.

    Attributes:
        distance: of each face to the body, metres.
        to_hand: of each face to the nearer hand, metres.
        sector: of each face about the person (`_sectors`).
        flat: share of each face on a board.
        lacked: how far the other side of the person lacks each face, 0 to 1.
        pairs: the two faces of each edge.
        length: of each edge, centimetres.
        cost: of cutting each edge, square centimetres of evidence.
    """

    distance: Float64[np.ndarray, " M"]
    to_hand: Float64[np.ndarray, " M"]
    sector: Int64[np.ndarray, " M"]
    flat: Float64[np.ndarray, " M"]
    lacked: Float64[np.ndarray, " M"]
    pairs: Int64[np.ndarray, "P 2"]
    length: Float64[np.ndarray, " P"]
    cost: Float64[np.ndarray, " P"]


_LEAST_AREA = 60.0
"""Square centimetres of a thing; less is a ring, a cuff or the error of a fitted hand."""
_LEAST_REACH = 0.06
"""Distance in metres of a thing from the body; fists and wrong fingers stay within."""
_TOUCHES = 0.03
"""Metres from the hand within which a thing begins."""
_LEFT_OF_HAND = 120.0
"""Square centimetres that the scan shows of a hand beside the thing in it, a third of it; less is the thing itself."""
_LARGER_THAN_HANDS = 900.0
"""Square centimetres from which a piece is a thing, although the scan does not show the hand where the body has it."""
_SMOOTH_BORDER = 0.6
"""Mean cost of the cut, as a share of that through smooth and plain surface, from which it is no border of a thing."""
_LONG_BORDER = 7.5
"""Squared length of a border by the area within it from which a piece is a flap of cloth; a disc has 4 pi. Of 72 things
on procedural people the longest has 7.0, of flaps of capes and wide sleeves the shortest 7.9."""
_CLAMPED, _CLAMPED_TOUCHES, _CLAMPED_BORDER = 0.5, 0.015, 0.35
"""A board between arm and chest has a long border: it is flat by this share, comes as near to the hand (metres), and
its border lies in folds (mean cost)."""


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
    where: _Where,
    hands: list[tuple[np.ndarray, float]],
    *,
    paired: Float64[np.ndarray, " M"],
    known: Bool[np.ndarray, " M"],
) -> FoundObjects:
    """Keep the pieces of a cut that are things.

    Args:
        mesh: the scan.
        cut: faces on the side of things.
        where: measures of faces and edges.
        hands: points of either hand of the body, and what the rest of the scan shows of it, square centimetres.
        paired: 1 where a face 3 cm off an arm or more has its like at the other arm, else 0.
        known: faces of things; a piece with them need not show by its border that it is one.
    """
    inside, pairs = cut[where.pairs], where.pairs
    piece = component_labels(pairs[inside.all(axis=1)], len(cut))
    faces, notes = np.zeros(len(cut), dtype=bool), []
    for number in np.unique(piece[cut]):
        own = cut & (piece == number)
        areas, to_hand = mesh.face_areas[own] * _CM2, where.to_hand[own]
        area = float(areas.sum())
        held = to_hand.min() <= _TOUCHES
        if area < _LEAST_AREA or where.distance[own].max() < _LEAST_REACH:
            continue
        # Clothes that hang far off the legs go round the person; a thing is on one side of her.
        around = np.bincount(where.sector[own], areas, minlength=_SECTORS) / area
        if (around > 0.02).sum() >= _ALL_ROUND:
            continue
        if areas @ paired[own] > 0.3 * area:
            continue
        # A hand that what is left of the scan does not show lies elsewhere: then a small piece is the hand itself.
        center = mesh.face_centers[own][to_hand.argmin()]
        nearest = int(np.argmin([np.linalg.norm(h - center, axis=1).min() if len(h) else np.inf for h, _ in hands]))
        if held and hands[nearest][1] < _LEFT_OF_HAND and area < _LARGER_THAN_HANDS:
            continue
        # The cost of its border, relative to a border of the same length through smooth and plain surface.
        border = own[pairs[:, 0]] != own[pairs[:, 1]]
        length = float(where.length[border].sum())
        dear = float(where.cost[border].sum()) / max(_LENGTH_COST * length, 1e-9)
        clamped = areas @ where.flat[own] > _CLAMPED * area and to_hand.min() < _CLAMPED_TOUCHES
        # Squared length of the border by area times its mean cost is 0.1 of backpacks and 0.2 of a stick that goes on
        # smoothly into the fist about it, 1.5 and more of flaps, whose borders are long or smooth.
        apart = dear * length**2 < 0.4 * area
        proven = bool(known[own].any())
        if dear > _SMOOTH_BORDER and not apart and not proven:
            continue
        # Between fingers about a thing the border is long but lies in edges of colour: the product is 0.5 of bottles.
        tight = proven or (held and dear * length**2 < 0.8 * area) or (clamped and dear < _CLAMPED_BORDER)
        if length**2 > _LONG_BORDER * area and not tight:
            continue
        # What is off the hands is worn, from 150 cm2 on and beginning beside the body, where the other side of the
        # person lacks two fifths of it, or where it stands 12 cm off her.
        deep = where.distance[own].max() > 0.12 and apart
        near = area > 150.0 and where.distance[own].min() < _WORN[0][1]
        if not held and not (near and (deep or areas @ where.lacked[own] > 0.4 * area)):
            continue
        faces |= own
        place = "at a hand" if held else "worn off the hands"
        notes.append(f"a thing of {area:.0f} cm2 {place} is labelled object")
    return FoundObjects(faces | _enclosed(mesh, faces, where), tuple(notes))


def _enclosed(mesh: TriangleMesh, faces: Bool[np.ndarray, " M"], where: _Where) -> Bool[np.ndarray, " M"]:
    """Return the pieces of the surface that things go all round, as the inside of a folder that an arm presses.

    Fingers that reach round a thing are such pieces, too, and stay what they are: they are at the hand.
    """
    left = ~faces
    piece = component_labels(where.pairs[left[where.pairs].all(axis=1)], len(faces))
    border = faces[where.pairs[:, 0]] != faces[where.pairs[:, 1]]
    beside = np.unique(piece[where.pairs[border]][left[where.pairs[border]]])
    area = np.bincount(piece, mesh.face_areas * left)
    to_hand = np.bincount(piece, mesh.face_areas * left * where.to_hand) / np.maximum(area, 1e-12)
    # The person herself is the largest piece beside a thing.
    inside = beside[(area[beside] < 0.5 * area[beside].max(initial=0.0)) & (to_hand[beside] > 2.0 * _TOUCHES)]
    return left & np.isin(piece, inside)
