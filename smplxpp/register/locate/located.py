"""LocatedBody: a body found in a bare surface."""

from __future__ import annotations

from dataclasses import dataclass, field

from smplxpp.core.params import BodyParams


@dataclass(frozen=True)
class Candidate:
    """One way in which a body may stand in a surface.

    Attributes:
        pose: where the search for it began, in words. facing_degrees: its front, about +Y from +Z.
        cost: lower is better; about millimetres.
        covered: share of the surface that it explains. shown: share of its hands, face and feet that the surface has.
    """

    pose: str
    facing_degrees: float
    cost: float
    covered: float
    shown: float


@dataclass(frozen=True, eq=False)
class LocatedBody:
    """Where the body is in a bare surface.

    Attributes:
        params: one row. confidence: from 0 to 1; below 0.5 somebody should look at it.
        problems: what speaks against it and what to do, in words.
        candidates: all that were followed to the end, the chosen one first.
    """

    params: BodyParams
    confidence: float
    problems: tuple[str, ...] = ()
    candidates: tuple[Candidate, ...] = field(default=())
