"""Minimise all terms of a window of frames by damped Gauss-Newton steps, and measure the result.

Every step linearises the terms at the state, computes their robust weights there (iteratively reweighted least
squares), and solves the normal equations with a fixed Levenberg-Marquardt damping of 1e-3. Steps are limited in length
instead of being tested for descent. After a step the gaps between body and cloth are estimated again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.native import map_in_threads
from smplxpp.register.keypoint_term import KeypointTerm
from smplxpp.register.kinematics import BodyPoints, BodyState, Kinematics
from smplxpp.register.landmark_term import LandmarkTerm
from smplxpp.register.normal_equations import Columns, NormalEquations, Products
from smplxpp.register.priors import Priors
from smplxpp.register.scan_term import ScanTerm
from smplxpp.register.silhouette_term import SilhouetteTerm

# Standard deviation in metres at which a joint's confidence is 1/2. It separates joints that are seen from those that
# the priors fill in: 20 to 45 mm in a laboratory's four views with a calibration that is off by 15 pixels, 2 to 12 mm
# with exact ones; at least 144 mm for the elbow, 300 mm for the wrist or ankle of a hidden limb.
_HALF_KNOWN = 0.08


@dataclass(frozen=True, eq=False)
class Terms:
    """The terms of a window of frames; each kind of observation may be missing.

    Attributes:
        priors: terms that need no observation.
        tells_shape: whether a frame may change the shape.
        keypoints: reprojection errors.
        landmarks: distances of points in space.
        silhouettes: distances to the contours of masks.
        scans: distances to scans.
    """

    priors: Priors
    tells_shape: Bool[np.ndarray, " T"]
    keypoints: KeypointTerm | None = None
    landmarks: LandmarkTerm | None = None
    silhouettes: SilhouetteTerm | None = None
    scans: ScanTerm | None = None

    def points(self) -> list[KeypointTerm | LandmarkTerm]:
        """Return the terms of named points, which are fitted first."""
        return [term for term in (self.keypoints, self.landmarks) if term is not None]

    def surfaces(self) -> list[SilhouetteTerm | ScanTerm]:
        """Return the terms of surfaces, which estimate gaps."""
        return [term for term in (self.silhouettes, self.scans) if term is not None]

    def residuals(self, kinematics: Kinematics, state: BodyState) -> dict[str, Float64[np.ndarray, " T"]]:
        """Return the residuals of every kind of observation in each frame, in pixels or millimetres; NaN for none."""
        postures = [kinematics.posture(state, row) for row in range(len(state))]
        out: dict[str, np.ndarray] = {}
        if self.keypoints is not None:
            term = self.keypoints
            out["keypoints_px"] = np.array([term.residual_px(r, kinematics, p) for r, p in enumerate(postures)])
        if self.landmarks is not None:
            away = np.array([self.landmarks.distances(r, kinematics, p) for r, p in enumerate(postures)])
            out["landmarks_mm"] = 1e3 * np.array([np.median(d[d == d]) if (d == d).any() else np.nan for d in away])
        if self.silhouettes is not None:
            contours = self.silhouettes
            out["silhouette_px"] = np.array([contours.residual_px(r, kinematics, p) for r, p in enumerate(postures)])
        if self.scans is not None:
            # Means over the points of a scan in millimetres: skin to the body, and cloth that is inside of it.
            both = np.array([self.scans.residual_mm(r, kinematics, p) for r, p in enumerate(postures)])
            out["skin_mm"], out["inside_mm"] = both[:, 0], both[:, 1]
        return out


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
    """Minimise the terms, starting at a state.

    Args:
        kinematics: of the body.
        columns: order of the unknowns.
        state: initial values.
        terms: what is minimised.
        steps: number of Gauss-Newton steps.
        solve_shape: whether the shape is solved for; else it is held.
        point_scales: for each step, the multiple of the noise of named points; values that fall to 1 widen the robust
            kernel at first, so that far points still pull (graduated non-convexity).
        step_done: called after each step with its index.

    Returns:
        The state, and the normal equations of the last step.
    """
    equations = NormalEquations(columns, len(state))
    for k in range(steps):
        for named in terms.points():
            named.scale = 1.0 if point_scales is None else float(point_scales[k])
        equations = assemble(kinematics, columns, state, terms, solve_shape=solve_shape)
        # Linearisation holds for some 20 degrees; longer steps are shortened.
        step = equations.solve(damping=1e-3, solve_shape=solve_shape).limited(angle=0.35, length=0.25)
        state = kinematics.updated(state, step.rotvecs, step.transl, step.betas, step.expression)
        for term in terms.surfaces():
            term.estimate_gaps()
        step_done(k)
    return state, equations


def assemble(
    kinematics: Kinematics, columns: Columns, state: BodyState, terms: Terms, *, solve_shape: bool
) -> NormalEquations:
    """Return the normal equations of all terms at a state."""
    equations = NormalEquations(columns, len(state))
    used = [*terms.points(), *terms.surfaces()]

    def of_frame(row: int) -> Products:
        # A frame that may not tell the shape, such as a held-out one, still determines its own pose.
        posture, products = kinematics.posture(state, row), Products(columns)
        for term in used:
            term.add(products, row, kinematics, posture, shape=bool(terms.tells_shape[row]) and solve_shape)
        return products

    # Frames are independent. Their products are summed in their order, so that threads change no bit.
    at_once = 64  # frames whose products are kept, about a megabyte each
    for first in range(0, len(state), at_once):
        rows = range(first, min(first + at_once, len(state)))
        for row, products in zip(rows, map_in_threads(of_frame, rows), strict=True):
            equations.add_products(row, products)
    terms.priors.add(equations, state, shape=solve_shape)
    return equations


def joint_confidence(
    kinematics: Kinematics, state: BodyState, equations: NormalEquations, rows: np.ndarray
) -> Float64[np.ndarray, "n J"]:
    """Return the confidence of every joint's position in some frames, from 0 to 1.

    The confidence is `1 / (1 + (s / 80 mm)^2)`, where `s^2 = trace(J C J^T)` is the variance of the joint's position, J
    its Jacobian by the unknowns of the frame, and C their covariance with all other frames held.
    """
    body, columns = kinematics.body, equations.columns
    joints = BodyPoints.of_joints(body, np.arange(body.joint_count))
    out = np.zeros((len(rows), body.joint_count))
    for k, row in enumerate(rows):
        # Positions depend on the shape, too; its columns are cut off because the shape is known from all frames
        # together.
        motion = kinematics.motion(joints, kinematics.posture(state, int(row)))
        jacobian = columns.jacobian(motion)[..., : columns.count]
        covariance = equations.covariance(int(row))
        variance = np.einsum("jxp,pq,jxq->j", jacobian, covariance, jacobian, optimize=True)
        out[k] = 1.0 / (1.0 + np.maximum(variance, 0.0) / _HALF_KNOWN**2)
    return out


def unlikely_shape(state: BodyState) -> bool:
    """Return whether a shape is that of no person: of 20 standard normal betas 1 in 200 has a mean square of 2."""
    return len(state.betas) > 0 and float((state.betas**2).mean()) > 2.0


def explains_as_well(one: Mapping[str, np.ndarray], other: Mapping[str, np.ndarray]) -> bool:
    """Return whether one body explains keypoints, contours and skin as well as another, within 15 % of the medians."""
    seen = {
        name: np.isfinite(one[name]) & np.isfinite(other[name])
        for name in ("keypoints_px", "landmarks_mm", "silhouette_px", "skin_mm")
        if name in one
    }
    return all(
        np.median(one[name][rows]) <= 1.15 * np.median(other[name][rows]) for name, rows in seen.items() if rows.any()
    )
