"""How sure a located body is, what speaks against it, and what is no person at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.register.locate.search import Found, Search

# A surface that the body explains to less than this share, or that has so little of hands, face and feet, is nobody's.
_LEAST_COVERED, _LEAST_SHOWN = 0.5, 0.25
_DOUBTFUL_COVERED = 0.8
# Costs apart from which two facings are told, and a cost that good fits stay below.
_MARGIN, _GOOD_COST = 4.0, 18.0


def refuse_what_is_no_person(found: Found) -> None:
    """Raise where body and surface have too little in common.

    Raises:
        InputError: no person, or less than a whole one.
    """
    fit = found.misfit
    if fit.covered < _LEAST_COVERED or fit.shown < _LEAST_SHOWN:
        raise InputError(
            "scan",
            expected="one whole person, standing about upright",
            received=f"a surface of which a body explains {fit.covered:.0%}, with {fit.shown:.0%} of its hands, face "
            "and feet",
            remedy="cut away everything but the person, check --up and --units, or place landmarks by hand",
        )


def confidence_of(best: Found, others: Sequence[Found]) -> float:
    """From 0 to 1: how far the other facing is behind, and how well the best explains the surface."""
    rival = [one.cost - best.cost for one in others if one.facing @ best.facing < 0]
    apart = min(rival) if rival else _MARGIN
    told = 1.0 / (1.0 + np.exp(-(apart - _MARGIN / 2) / (_MARGIN / 4)))
    good = 1.0 / (1.0 + np.exp((best.cost - _GOOD_COST) / 1.5))
    whole = np.clip((best.misfit.covered - _LEAST_COVERED) / (_DOUBTFUL_COVERED - _LEAST_COVERED), 0.0, 1.0)
    return float(told * good * whole)


def problems_of(best: Found, others: Sequence[Found], search: Search) -> tuple[str, ...]:
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
    return tuple(out)
