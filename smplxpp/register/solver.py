"""Gauss-Newton over a window of frames: all terms, one step after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.register.keypoint_term import KeypointTerm
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.landmark_term import LandmarkTerm
from smplxpp.register.normal_equations import Columns, NormalEquations
from smplxpp.register.priors import Priors
from smplxpp.register.scan_term import ScanTerm
from smplxpp.register.silhouette_term import SilhouetteTerm

_LARGEST_TURN, _LARGEST_MOVE = 0.35, 0.25
_DAMPING = 1e-3


@dataclass(frozen=True, eq=False)
class Terms:
    """What the frames of a window are compared with; any may be missing.

    Attributes:
        tells_shape: frames that the shape is solved on.
    """

    priors: Priors
    tells_shape: Bool[np.ndarray, " T"]
    keypoints: KeypointTerm | None = None
    landmarks: LandmarkTerm | None = None
    silhouettes: SilhouetteTerm | None = None
    scans: ScanTerm | None = None

    def points(self) -> list[KeypointTerm | LandmarkTerm]:
        """Those of named points, which come first."""
        return [term for term in (self.keypoints, self.landmarks) if term is not None]

    def surfaces(self) -> list[SilhouetteTerm | ScanTerm]:
        """Those that learn gaps."""
        return [term for term in (self.silhouettes, self.scans) if term is not None]


def gauss_newton(
    kinematics: Kinematics,
    columns: Columns,
    state: BodyState,
    terms: Terms,
    *,
    steps: int,
    solve_shape: bool,
    point_scales: Float64[np.ndarray, " n"] | None = None,
    step_done: Callable[[int], None] = lambda k: None,
) -> tuple[BodyState, NormalEquations]:
    """Minimise the terms from a state.

    Args:
        point_scales: by step, multiples of the named points' noise, falling to 1: what is far still pulls at first.

    Returns:
        The state and the equations at its last step.
    """
    equations = NormalEquations(columns, len(state))
    for k in range(steps):
        for named in terms.points():
            named.scale = 1.0 if point_scales is None else float(point_scales[k])
        equations = assemble(kinematics, columns, state, terms, solve_shape=solve_shape)
        step = equations.solve(damping=_DAMPING, solve_shape=solve_shape)
        step = step.limited(angle=_LARGEST_TURN, length=_LARGEST_MOVE)
        state = kinematics.updated(state, step.turns, step.transl, step.betas, step.expression)
        for term in terms.surfaces():
            term.learn()
        step_done(k)
    return state, equations


def assemble(
    kinematics: Kinematics, columns: Columns, state: BodyState, terms: Terms, *, solve_shape: bool
) -> NormalEquations:
    """The normal equations at a state."""
    equations = NormalEquations(columns, len(state))
    used = [*terms.points(), *terms.surfaces()]
    for row in range(len(state)):
        posture = kinematics.posture(state, row)
        for term in used:
            term.add(equations, row, kinematics, posture, shape=bool(terms.tells_shape[row]) and solve_shape)
    terms.priors.add(equations, state, shape=solve_shape)
    return equations
