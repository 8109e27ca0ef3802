"""Decide whether a found body is accepted: bounds, confidence, missing parts, and findings about the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.surface_points import SurfacePoints
from smplxpp.register.locate.persons import (
    Piece,
    feet_of,
    heads,
    largest_piece,
    others_carried,
    people_apart,
    share_beyond,
    unlike_person,
)
from smplxpp.register.locate.search import Found


@dataclass(frozen=True)
class LocateBounds:
    """Bounds that refuse a located body or lower its confidence.

    They trade people that are refused against chairs, boxes and partial scans that are accepted; `python -m benchmarks
    scan_alone` measures both.

    Attributes:
        least_covered: smallest share of the surface that a body must explain.
        least_shown: smallest share of hands, face and feet that the surface must show.
        largest_shape: mean square of betas above which no person exists; they have unit variance.
        doubtful_covered: share of the surface below which the confidence falls.
        doubtful_shape: mean square of betas above which the confidence falls, unless the surface is that of the body.
        own_shape: share of the surface that a body must explain, with `good_bare` at hands, face and feet, to have any
            shape: a heavy woman has a mean square of 10, and her body explains .99.
        margin: difference of cost, millimetres, from which two facings are clearly distinct.
        doubtful_cost: cost from which rare poses are tried, millimetres.
        good_bare: mean distance of hands, face and feet to the surface at which the confidence is half, metres. Chosen
            on bodies in 18 procedural people and 17 real scans: right ones end at 22 mm, however wide the clothes are;
            other facings and poses begin at 25 mm.
        least_head: visible share of the head below which it is cut off: 145 right bodies have .55 and more, people
            without a head at most .08.
        least_carried: share of the surface from which a piece with a head of its own is a person: a child of 0.4 of a
            person's size has .15, a ball of 22 cm in a hand .05; no right body has a head on a piece of .05.
        most_beyond: share of the body outside the silhouettes of the surface from which this is a part of a person: a
            head is .07 to .10, both arms .16, shins and feet .20, what a search puts into legs or a bust on a stand .26
            and more, halves .39 and more; right bodies have at most .007.
    """

    least_covered: float = 0.5
    least_shown: float = 0.25
    largest_shape: float = 30.0
    doubtful_covered: float = 0.8
    doubtful_shape: float = 6.0
    own_shape: float = 0.95
    margin: float = 4.0
    doubtful_cost: float = 18.0
    good_bare: float = 0.024
    least_head: float = 0.3
    least_carried: float = 0.1
    most_beyond: float = 0.18


_BOUNDS = LocateBounds()
_SIDES = ("left", "right")
_OPEN_HAND = 0.4
"""Visible share of a hand below which its fingers are not found; fists show 0.35 to 0.5 where their pose is right."""
_LIMB_PARTS = ("left forearm", "right forearm", "left foot", "right foot")
_LIMB_SHARE = 0.03
"""Share of the surface in one piece that no part of the body explains, from which it may be a limb: arms that were
turned away from where 8 real people have them left 3.5 % and more."""
_STANDS = 0.003
"""Share of the surface that stands on the ground off the body, from which it is furniture: .017 of a man's chair."""
_HEAD_SHOWN = 0.5
"""Visible share of the head below which it may be missing; hair and hoods hide some of it."""


def no_person(found: Found) -> str:
    """Return the reason why the body found does not explain a surface; empty if it does."""
    fit = found.misfit
    if fit.covered < _BOUNDS.least_covered or fit.shown < _BOUNDS.least_shown or _shape(found) > _BOUNDS.largest_shape:
        unlike = ", and a body unlike any person" if _shape(found) > _BOUNDS.doubtful_shape else ""
        return (
            f"a surface of which a body explains {fit.covered:.0%}, with {fit.shown:.0%} of its hands, face and feet"
            + unlike
        )
    return ""


def is_doubtful(found: Found) -> bool:
    """Return whether the body found leaves so much unexplained that a rare pose may explain it better.

    Wide skirts leave up to a sixth of a surface unexplained, and do not make a body doubtful.
    """
    fit = found.misfit
    return (
        found.surface_cost > _BOUNDS.doubtful_cost
        or fit.covered < _BOUNDS.doubtful_covered
        or any(fit.parts[part] < 0.4 for part in _LIMB_PARTS)
    )


def findings_of(
    mesh: TriangleMesh, surface: SurfacePoints, best: Found, posed: TriangleMesh
) -> tuple[tuple[str, ...], float]:
    """Describe what a surface shows besides one whole person; return it with a factor for the confidence.

    Args:
        mesh: the surface.
        surface: points of it, which the best body was compared with.
        best: the body.
        posed: its visible surface.
    """
    out, trust = [], 1.0
    # What no body explains may be no person at all, or one beside furniture; parts of a person are then no finding.
    foreign = bool(no_person(best)) or best.misfit.bare > _BOUNDS.good_bare
    shape = unlike_person(mesh, surface) if foreign else ""
    if shape:
        return (shape,), 0.1
    four_legged = foreign and feet_of(surface) > 2
    # Several people: pieces of their size beside each other, or two heads in the upper half.
    apart = people_apart(mesh)
    if len(apart) > 1:
        trust = 0.1
        pieces = ", ".join(str(piece) for piece in apart)
        out.append(f"{len(apart)} pieces of a person's size beside each other ({pieces}): two people, or furniture")
    seen = heads(surface, float(mesh.face_areas.sum()))
    low, high = np.quantile(surface.points[:, 1], (0.0, 1.0))
    upper, pads = without_pads(seen[seen[:, 1] > 0.5 * (low + high)], posed, best.facing)
    if len(upper) > 1:
        trust = min(trust, 0.3)
        heights = " and ".join(f"{head[1] - low:.2f}" for head in upper[:3])
        what = "a four-legged shape as an animal" if four_legged else "something round that is held"
        out.append(f"{len(upper)} heads, {heights} m above the lowest point: two people, or {what}")
    elif four_legged and not out:
        out.append("it stands on more than two feet: a four-legged shape as an animal, or several people")
    # Beside a person whose hands, face and feet are there; crossed boards have round places, too.
    carried: tuple[tuple[Piece, float], ...] = ()
    if best.misfit.bare < _BOUNDS.good_bare:
        carried = others_carried(mesh, surface, best.misfit.unexplained, posed=posed, least=_BOUNDS.least_carried)
    if carried:
        trust = 0.1
    for other, height in carried if not out else ():
        out.append(
            f"a head of its own, {height:.2f} m above the lowest point, on {other.share:.0%} of the surface, in one "
            f"piece of {other}, that is no part of the body found: a child, a doll or an animal"
        )
    # Half a person: no head anywhere, or neither legs nor feet. A hood shows some of a head; a cut shows nothing.
    if not len(seen) and best.misfit.parts["head"] < _HEAD_SHOWN:
        cut = best.misfit.parts["head"] < _BOUNDS.least_head
        trust = min(trust, 0.1 if cut else 0.3)
        out.append("no head: it is cut off above" if cut else "no head: it may be cut off above, or hidden by a hood")
    legs = [f"{side} {part}" for side in ("left", "right") for part in ("lower leg", "foot")]
    if all(best.misfit.parts[part] < 0.2 for part in legs):
        trust = min(trust, 0.3)
        out.append("neither lower legs nor feet: it may be cut off below")
    lacking = share_beyond(mesh, posed)
    if lacking > _BOUNDS.most_beyond:
        trust = min(trust, 0.1)
        out.append(f"{lacking:.0%} of the body found lies outside of the surface: a part of a person")
    elsewhere = "" if out else limb_elsewhere(surface, best)
    if elsewhere:
        trust = min(trust, 0.1)
        out.append(elsewhere)
    if not no_person(best) and best.misfit.covered >= _BOUNDS.doubtful_covered:
        return tuple(out), trust
    # Something large that is no part of a body.
    piece = largest_piece(surface, best.misfit.unexplained)
    if pads:
        out.append(
            f"{pads} round places as large as heads, alike on both sides of one head: armour or pads, which stand too "
            "far off for a body to be found in them; cut them away"
        )
    if piece is not None and piece.share > 0.1 and not carried:
        what = "furniture, another person, something held or a wide garment"
        what = "armour, something held or a wide garment" if pads else what
        # A person who sits is found with the chair, whose legs and back would become clothes that limbs draw along.
        # Something held is flat as well; furniture stands on the ground, 10 cm and more off the body.
        ground = surface.points[best.misfit.unexplained & (surface.points[:, 1] < low + 0.05 * (high - low))]
        stands = (cKDTree(posed.vertices).query(ground)[0] > 0.1).sum() > _STANDS * len(surface)
        flat = unlike_person(mesh, surface) if stands else ""
        if flat:
            trust, what = min(trust, 0.1), f"furniture, which stands beside the feet ({flat}); cut it away"
        out.append(f"{piece.share:.0%} of the surface, in one piece of {piece}, is no part of the body found: {what}")
    if float(high - low) < 1.2:
        out.append(
            f"only {high - low:.2f} m from the lowest to the highest point: a small child, or a part of a person"
        )
    return tuple(out), trust


def without_pads(
    found: Float64[np.ndarray, "K 3"], posed: TriangleMesh, facing: Float64[np.ndarray, " 2"]
) -> tuple[Float64[np.ndarray, "_ 3"], int]:
    """Return the heads that are no pads on both shoulders, and the number of those that are.

    Pads are pairs that mirror each other at the body's middle, within 10 cm, below a head in that middle. Two people
    have none between them that is higher.

    Args:
        found: places of round surface as large as heads.
        posed: the body that was found.
        facing: the direction that it faces, x and z.
    """
    close, beside = 0.05, 0.1  # metres
    across = np.array([facing[1], 0.0, -facing[0]])
    off = (found - posed.vertices.mean(axis=0)) @ across
    top = found[np.abs(off) < close, 1].max(initial=-np.inf)
    mirrored = found - 2.0 * off[:, None] * across
    near = np.linalg.norm(mirrored[:, None] - found[None], axis=2) < 2.0 * close
    pad = (near & (np.abs(off) > beside)[None]).any(axis=1) & (np.abs(off) > beside) & (found[:, 1] < top)
    return found[~pad], int(pad.sum())


def limb_elsewhere(surface: SurfacePoints, found: Found) -> str:
    """Return in words that a limb of the body lies in the air, while the surface shows a piece that may be it, or "".

    One of the two alone is no fault: limbs are cut off or hidden, things and wide clothes are no part of a body. A
    skirt hides feet and stands off the legs, so that they count only where a body explains little of the surface.
    """
    shown = found.misfit.parts
    lost = [f"{side} arm" for side in _SIDES if shown[f"{side} forearm"] < 0.4 and shown[f"{side} hand"] < 0.5]
    if found.misfit.covered < _BOUNDS.doubtful_covered:
        lost += [f"{side} leg" for side in _SIDES if max(shown[f"{side} lower leg"], shown[f"{side} foot"]) < 0.4]
    piece = largest_piece(surface, found.misfit.unexplained) if lost else None
    if piece is None or piece.share < _LIMB_SHARE:
        return ""
    return (
        f"{' and '.join(lost)} not where the body has it, and {piece.share:.0%} of the surface, in one piece of "
        f"{piece}, no part of the body found: a limb in the wrong place; place a landmark on its wrist or ankle"
    )


def confidence_of(best: Found, others: Sequence[Found]) -> float:
    """Return the confidence of the best candidate, from 0 to 1, as a product of five factors.

    A logistic function of its margin over the other facing (1/2 at half of the margin that is clearly distinct), one of
    the distance of its hands, face and feet to the surface, the share of the surface that it explains, 0.2 for an
    unlikely shape that the surface does not show, and 0.4 for missing parts. Clothes do not count: wide ones are as far
    from a right body as tight ones from a wrong one, while hands, face and feet are bare, or nearly so.
    """
    rival = [one.cost - best.cost for one in others if one.facing @ best.facing < 0]
    apart = min(rival) if rival else _BOUNDS.margin
    distinct = 1.0 / (1.0 + np.exp(-(apart - _BOUNDS.margin / 2) / (_BOUNDS.margin / 4)))
    # Half a logit per 0.6 mm, about the spread of right bodies.
    good = 1.0 / (1.0 + np.exp((best.misfit.bare - _BOUNDS.good_bare) / 0.0012))
    whole = np.clip(
        (best.misfit.covered - _BOUNDS.least_covered) / (_BOUNDS.doubtful_covered - _BOUNDS.least_covered), 0.0, 1.0
    )
    likely = 0.2 if _unlike_people(best) else 1.0
    return float(distinct * good * whole * likely * (0.4 if missing_parts(best) else 1.0))


def missing_parts(found: Found) -> list[str]:
    """Return the parts of the body that the surface does not show: less than 0.4 of a foot, 0.3 of the head (hair hides
    it), 0.2 of a forearm (wide sleeves hide it) or of a hand, or 0.4 of both, of an arm that is hidden in the trunk.

    Skirts hide lower legs, which are therefore never missing.
    """
    least = {"head": _BOUNDS.least_head, "foot": 0.4, "forearm": 0.2, "hand": 0.2, "leg": 0.0}
    shown = found.misfit.parts
    out = {part for part, share in shown.items() if share < least[part.split()[-1]]}
    for side in _SIDES:
        if max(shown[f"{side} forearm"], shown[f"{side} hand"]) < _OPEN_HAND:
            out |= {f"{side} forearm", f"{side} hand"}
    return [part for part in shown if part in out]


def closed_hands(found: Found) -> list[str]:
    """Return the hands of which the surface shows some, but not the fingers: fists, gloves, hands that hold."""
    missing = missing_parts(found)
    hands = [f"{side} hand" for side in _SIDES]
    return [hand for hand in hands if found.misfit.parts[hand] < _OPEN_HAND and hand not in missing]


def notes_of(best: Found, others: Sequence[Found]) -> tuple[str, ...]:
    """Return sentences about what a user should inspect and how to correct it."""
    out = []
    rival = [one for one in others if one.facing @ best.facing < 0]
    if rival and min(one.cost for one in rival) - best.cost < _BOUNDS.margin:
        out.append(
            "the person may face the other way: both facings fit about equally well; place the landmarks nose, "
            "left_wrist and right_wrist by hand (`smplxpp label`)"
        )
    if best.misfit.covered < _BOUNDS.doubtful_covered:
        out.append(
            f"a body explains only {best.misfit.covered:.0%} of the surface; if it shows something besides one person, "
            "cut that away"
        )
    missing = missing_parts(best)
    if missing:
        out.append(
            f"not found in the scan: {', '.join(missing)}. If it is cut off or hidden, its place is a guess; if it is "
            "there, place a landmark on it (`smplxpp label`)"
        )
    closed = closed_hands(best)
    if closed:
        out.append(
            f"fingers not found: {', '.join(closed)}. A fist, a glove or something held hides them; the arm is found, "
            "and the pose of the fingers is a guess"
        )
    if _unlike_people(best):
        out.append("the body that fits is unlike people: check --units and --up, and that the scan is whole")
    return tuple(out)


def _unlike_people(found: Found) -> bool:
    """Return whether a candidate has a shape that few people have and the surface does not show."""
    shown = found.misfit.covered >= _BOUNDS.own_shape and found.misfit.bare < _BOUNDS.good_bare
    return _shape(found) > _BOUNDS.doubtful_shape and not shown


def _shape(found: Found) -> float:
    """Return the mean square of a candidate's betas."""
    betas = found.state.betas
    return float((betas**2).mean()) if len(betas) else 0.0
