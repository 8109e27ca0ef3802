"""Fit one body to one surface by damped Gauss-Newton steps: the step, the ICP term, and the term of landmarks.

The ICP term is symmetric: every point of the body is paired with the nearest point of the surface, and every point of
the surface with the nearest point of the body, in the joint space of position and normal. A pair with difference r, the
surface's normal n, has the cost `GM(|r|; reach) / sigma^2 ((n . r)^2 + 0.15 |r - n (n . r)|^2)`, point-to-plane with a
little point-to-point; GM is the robust weight of Geman and McClure. The caller lets the reach fall from step to step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel
from smplxpp.core.errors import InputError
from smplxpp.core.surface_points import SurfacePoints, position_normal_features
from smplxpp.register.kinematics import BodyState, Kinematics, Posture
from smplxpp.register.landmarks import LandmarkModel, LandmarkPoints
from smplxpp.register.locate.proxy import BodyProxy
from smplxpp.register.normal_equations import Columns, NormalEquations, geman_mcclure
from smplxpp.register.priors import Priors


class Term(Protocol):
    """A term of the sum of squares of one posture."""

    def add(self, equations: NormalEquations, kinematics: Kinematics, posture: Posture) -> None:
        """Add the term to row 0 of the normal equations."""


def gauss_newton_step(
    kinematics: Kinematics, columns: Columns, state: BodyState, terms: Sequence[Term], priors: Priors
) -> BodyState:
    """Take one damped Gauss-Newton step on the terms and priors, limited to 0.5 rad and 0.25 m."""
    equations = NormalEquations(columns, 1)
    posture = kinematics.posture(state, 0)
    for term in terms:
        term.add(equations, kinematics, posture)
    priors.add(equations, state, shape=True)
    step = equations.solve(damping=1e-3, solve_shape=True).limited(angle=0.5, length=0.25)
    return kinematics.updated(state, step.rotvecs, step.transl, step.betas, step.expression)


@dataclass
class IcpTerm:
    """The symmetric ICP term; see the module's docstring.

    Attributes:
        proxy: points of the body.
        surface: points of the scan.
        sigma: standard deviation of a distance, metres.
        reach: cutoff of the robust kernel, metres.
        count: number of independent points that all pairs together count as.
    """

    proxy: BodyProxy
    surface: SurfacePoints
    sigma: float = 0.02
    reach: float = 0.2
    count: float = 300.0

    def add(self, equations: NormalEquations, kinematics: Kinematics, posture: Posture) -> None:
        """Add the pairs of both directions to the normal equations."""
        motion = kinematics.motion(self.proxy.points, posture, equations.columns.joints)
        points = motion.points
        _, normals = self.proxy.posed(kinematics, posture)
        jacobian = equations.columns.jacobian(motion)
        # Nearest neighbours in position and normal; each direction has half of the weight.
        there = position_normal_features(points, normals)
        surface = self.surface
        _, to_surface = surface.tree.query(there)
        _, to_body = cKDTree(there).query(surface.tree.data)
        body = np.concatenate([np.arange(len(points)), to_body])
        scan = np.concatenate([to_surface, np.arange(len(surface))])
        share = np.concatenate([np.full(len(points), 0.5 / len(points)), np.full(len(surface), 0.5 / len(surface))])
        # Robust weights; pairs whose normals differ by more than some 80 degrees are dropped.
        apart = points[body] - surface.points[scan]
        facing = np.einsum("nx,nx->n", normals[body], surface.normals[scan])
        distance = np.linalg.norm(apart, axis=1)
        weight = share * self.count / self.sigma**2 * geman_mcclure(distance, self.reach) * (facing > 0.2)
        _accumulate(equations, jacobian, body, apart, surface.normals[scan], weight)


def _accumulate(
    equations: NormalEquations,
    jacobian: Float64[np.ndarray, "N 3 P"],
    body: np.ndarray,
    apart: np.ndarray,
    normal: np.ndarray,
    weight: np.ndarray,
) -> None:
    """Add pairs with their whole weight along the normal and 0.15 of it in the tangent plane.

    The information matrices of all pairs of a body point are summed first. With the sum `H = V L V^T` and gradient g,
    the three rows `L^1/2 V^T` with the residuals `L^-1/2 V^T g` give the same normal equations.
    """
    count, along = len(jacobian), 0.15
    information = np.zeros((count, 3, 3))
    vector = np.zeros((count, 3))
    matrix = weight[:, None, None] * (along * np.eye(3) + (1.0 - along) * normal[:, :, None] * normal[:, None, :])
    pull = np.einsum("nxy,ny->nx", matrix, apart)
    for x in range(3):
        vector[:, x] = np.bincount(body, pull[:, x], minlength=count)
        for y in range(3):
            information[:, x, y] = np.bincount(body, matrix[:, x, y], minlength=count)
    kept = np.flatnonzero(np.einsum("nxx->n", information) > 0)
    values, axes = np.linalg.eigh(information[kept])
    values = np.maximum(values, 1e-9 * np.maximum(values[:, -1:], 1e-12))
    root = np.sqrt(values)[:, :, None] * axes.transpose(0, 2, 1)
    target = (axes.transpose(0, 2, 1) @ vector[kept, :, None])[..., 0] / np.sqrt(values)
    rows = root @ jacobian[kept]
    equations.add(0, rows.reshape(-1, rows.shape[-1]), target.reshape(-1), shape=True)


@dataclass
class PinnedLandmarks:
    """Landmarks whose position is known: `sum_k GM(|x_k - p_k|; cutoff) |x_k - p_k|^2 / (15 mm)^2`.

    Attributes:
        points: their positions p, metres.
        landmarks: the same points of the body, x.
        cutoff: of the robust kernel, metres; infinite during the search.
    """

    points: Float64[np.ndarray, "K 3"]
    landmarks: LandmarkPoints
    cutoff: float = np.inf

    @staticmethod
    def of(body: BodyModel, landmarks: Mapping[str, Float[np.ndarray, " 3"]]) -> PinnedLandmarks:
        """Look landmarks up on a body by name; see `LandmarkModel`.

        Raises:
            InputError: a name that the body does not have, or a point that is not finite.
        """
        model = LandmarkModel.of(body, tuple(landmarks))
        if model.unknown:
            raise InputError(
                "landmarks",
                expected="names of joints or of points that the body has (docs/registration.md)",
                received=", ".join(model.unknown),
            )
        points = np.array([np.asarray(landmarks[name], dtype=np.float64) for name in model.names]).reshape(-1, 3)
        if not np.isfinite(points).all():
            raise InputError("landmarks", expected="finite points (x, y, z)", received="NaN or infinity")
        return PinnedLandmarks(points, LandmarkPoints.of(body, model))

    def add(self, equations: NormalEquations, kinematics: Kinematics, posture: Posture) -> None:
        """Add all landmarks to the normal equations."""
        motion, points = self.landmarks.motion(kinematics, posture)
        residual = points - self.points
        weight = geman_mcclure(np.linalg.norm(residual, axis=1), self.cutoff) / 0.015**2
        mixed = self.landmarks.combined(equations.columns.jacobian(motion))
        root = np.sqrt(weight)[:, None]
        equations.add(0, (mixed * root[..., None]).reshape(-1, mixed.shape[2]), (residual * root).ravel(), shape=True)

    def distance(self, kinematics: Kinematics, posture: Posture) -> float:
        """Return the mean distance of the landmarks, metres, each truncated at a quarter of a metre."""
        apart = self.landmarks.points(kinematics, posture) - self.points
        return float(np.minimum(np.linalg.norm(apart, axis=1), 0.25).mean())

    def make_robust(self) -> None:
        """Set the cutoff to 10 cm, so that misplaced landmarks are ignored once the body is near."""
        self.cutoff = 0.1
