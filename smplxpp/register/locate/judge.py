"""How sure a located body is, what speaks against it, and what is no person at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.register.locate.search import Found

# A surface that the body explains to less than this share, or that has so little of hands, face and feet, is nobody's.
_LEAST_COVERED, _LEAST_SHOWN = 0.5, 0.25
_DOUBTFUL_COVERED = 0.8
# A part that is there is shown to more than half; of the head, hair may hide much.
_LEAST_PART = {"head": 0.3, "left lower leg": 0.0, "right lower leg": 0.0}
_LEAST_OTHER_PART = 0.4
# Costs apart from which two facings are told, and a cost that good fits stay below.
_MARGIN, _GOOD_COST = 4.0, 18.0
# Betas have unit variance; nobody's squares add up to more than this many times their number.
_LARGEST_SHAPE, _NOBODYS_SHAPE = 6.0, 30.0


def refuse_what_is_no_person(found: Found) -> None:
    """Raise where body and surface have too little in common.

    Raises:
        InputError: no person, or less than a whole one.
    """
    fit = found.misfit
    if fit.covered < _LEAST_COVERED or fit.shown < _LEAST_SHOWN or _shape(found) > _NOBODYS_SHAPE:
        raise InputError(
            "scan",
            expected="one whole person, standing about upright",
            received=f"a surface of which a body explains {fit.covered:.0%}, with {fit.shown:.0%} of its hands, face "
            f"and feet{', and a body unlike any person' if _shape(found) > _LARGEST_SHAPE else ''}",
            remedy="cut away everything but the person, check --up and --units, or place landmarks by hand",
        )


def confidence_of(best: Found, others: Sequence[Found]) -> float:
    """From 0 to 1: how far the other facing is behind, how well the best explains the surface, what is missing."""
    rival = [one.cost - best.cost for one in others if one.facing @ best.facing < 0]
    apart = min(rival) if rival else _MARGIN
    told = 1.0 / (1.0 + np.exp(-(apart - _MARGIN / 2) / (_MARGIN / 4)))
    good = 1.0 / (1.0 + np.exp((best.cost - _GOOD_COST) / 1.5))
    whole = np.clip((best.misfit.covered - _LEAST_COVERED) / (_DOUBTFUL_COVERED - _LEAST_COVERED), 0.0, 1.0)
    likely = 1.0 if _shape(best) <= _LARGEST_SHAPE else 0.2
    return float(told * good * whole * likely * (0.4 if missing_parts(best) else 1.0))


def missing_parts(found: Found) -> list[str]:
    """Names of parts that the surface does not show where the body has them."""
    return [part for part, share in found.misfit.parts.items() if share < _LEAST_PART.get(part, _LEAST_OTHER_PART)]


def problems_of(best: Found, others: Sequence[Found]) -> tuple[str, ...]:
    """What a user should look at."""
    out = []
    rival = [one for one in others if one.facing @ best.facing < 0]
    if rival and min(one.cost for one in rival) - best.cost < _MARGIN:
        out.append(
            "the person may face the other way: both facings fit about equally well; place the landmarks nose, "
            "left_wrist and right_wrist by hand (`smplxpp label`)"
        )
    if best.misfit.covered < _DOUBTFUL_COVERED:
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
    if _shape(best) > _LARGEST_SHAPE:
        out.append("the body that fits is unlike people: check --units and --up, and that the scan is whole")
    return tuple(out)


def _shape(found: Found) -> float:
    """Mean square of the betas."""
    betas = found.state.betas
    return float((betas**2).mean()) if len(betas) else 0.0
