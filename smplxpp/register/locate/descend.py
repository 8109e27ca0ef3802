"""Gauss-Newton on one frame: body and surface drawn together, from far to near."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from smplxpp.core.surface_points import SurfacePoints, position_normal_features
from smplxpp.register.kinematics import BodyState, Kinematics, Posture
from smplxpp.register.locate.proxy import BodyProxy
from smplxpp.register.normal_equations import Columns, NormalEquations
from smplxpp.register.priors import Priors
from smplxpp.register.robust import geman_mcclure

_LARGEST_TURN, _LARGEST_MOVE, _DAMPING = 0.5, 0.25, 1e-3
# A point counts along its surface so many times less than across it.
_ALONG = 0.15
_FACING = 0.2


class Term(Protocol):
    """Adds its squares to the equations of one posture."""

    def add(self, equations: NormalEquations, kinematics: Kinematics, posture: Posture) -> None:
        """Add what is seen of row 0."""


def descend(
    kinematics: Kinematics, columns: Columns, state: BodyState, terms: Sequence[Term], priors: Priors
) -> BodyState:
    """One step."""
    equations = NormalEquations(columns, 1)
    posture = kinematics.posture(state, 0)
    for term in terms:
        term.add(equations, kinematics, posture)
    priors.add(equations, state, shape=True)
    step = equations.solve(damping=_DAMPING, solve_shape=True).limited(angle=_LARGEST_TURN, length=_LARGEST_MOVE)
    return kinematics.updated(state, step.turns, step.transl, step.betas, step.expression)


@dataclass
class DrawnTogether:
    """Points of body and surface, each to the nearest of the other that faces the same way.

    Attributes:
        sigma: metres that a distance is sure to. reach: beyond it a pair counts less and less.
        count: independent points that all of them stand for.
    """

    proxy: BodyProxy
    surface: SurfacePoints
    sigma: float = 0.02
    reach: float = 0.2
    count: float = 300.0

    def add(self, equations: NormalEquations, kinematics: Kinematics, posture: Posture) -> None:
        """Add both directions."""
        motion = kinematics.motion(self.proxy.points, posture)
        points = motion.points
        _, normals = self.proxy.posed(kinematics, posture)
        jacobian = equations.columns.jacobian(motion)
        there = position_normal_features(points, normals)
        surface = self.surface
        _, to_surface = surface.tree.query(there)
        _, to_body = cKDTree(there).query(surface.tree.data)
        body = np.concatenate([np.arange(len(points)), to_body])
        scan = np.concatenate([to_surface, np.arange(len(surface))])
        share = np.concatenate([np.full(len(points), 0.5 / len(points)), np.full(len(surface), 0.5 / len(surface))])
        apart = points[body] - surface.points[scan]
        facing = np.einsum("nx,nx->n", normals[body], surface.normals[scan])
        distance = np.linalg.norm(apart, axis=1)
        weight = share * self.count / self.sigma**2 * geman_mcclure(distance, self.reach) * (facing > _FACING)
        _accumulate(equations, jacobian, body, apart, surface.normals[scan], weight)


def _accumulate(
    equations: NormalEquations,
    jacobian: Float64[np.ndarray, "N 3 P"],
    body: np.ndarray,
    apart: np.ndarray,
    normal: np.ndarray,
    weight: np.ndarray,
) -> None:
    """Add pairs: whole weight across the surface, little along it; pairs of one point are summed first."""
    count = len(jacobian)
    information = np.zeros((count, 3, 3))
    vector = np.zeros((count, 3))
    matrix = weight[:, None, None] * (_ALONG * np.eye(3) + (1.0 - _ALONG) * normal[:, :, None] * normal[:, None, :])
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
