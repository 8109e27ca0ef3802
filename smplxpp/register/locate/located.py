"""Hold the result of a search for the body in a surface, and the error if there is no person in it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams


@dataclass(frozen=True)
class Candidate:
    """A body that was fitted to the surface to the end.

    Attributes:
        pose: name of the pose of its start.
        facing_degrees: direction in which it faces, about +Y from +Z.
        cost: misfit with the cost of the pose, millimetres; lower is better.
        covered: share of the surface that it explains.
        shown: share of its hands, face and feet that the surface shows.
    """

    pose: str
    facing_degrees: float
    cost: float
    covered: float
    shown: float


@dataclass(frozen=True, eq=False)
class LocatedBody:
    """The body that was found in a bare surface.

    Attributes:
        params: one row.
        confidence: from 0 to 1; a result below 0.5 should be inspected.
        notes: sentences about evidence against it, with remedies.
        candidates: all that were fitted to the end, the winner first.
        moved: limbs that were found elsewhere when they were searched again.
        findings: what the surface shows that is not one whole person, in words.
    """

    params: BodyParams
    confidence: float
    notes: tuple[str, ...] = ()
    candidates: tuple[Candidate, ...] = field(default=())
    moved: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()


class BodyNotFoundError(InputError):
    """A scan in which no body was found, or none with enough confidence to build on.

    Attributes:
        confidence: of the best body that was found, from 0 to 1.
        params: that body, one row.
        findings: what the scan shows that is not one whole person, in words.
        picture: the scan, and the body within it from front and side; None where nothing was drawn.

    Example:
        >>> try:
        ...     smplxpp.build_template("two_people.obj")
        ... except smplxpp.BodyNotFoundError as error:  # doctest: +SKIP
        ...     print(error.confidence, error.findings)
    """

    def __init__(
        self,
        located: LocatedBody,
        *,
        received: str,
        remedy: str,
        picture: UInt8[np.ndarray, "H W 3"] | None = None,
    ) -> None:
        super().__init__("scan", expected="one whole person, standing about upright", received=received, remedy=remedy)
        self.confidence, self.params, self.findings = located.confidence, located.params, located.findings
        self.located, self.picture = located, picture
