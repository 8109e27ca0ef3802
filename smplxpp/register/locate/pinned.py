"""Landmarks in space: points of the body that are known to lie there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Float64

from smplxpp.body import BodyModel
from smplxpp.core.errors import InputError
from smplxpp.register.keypoint_term import carried_points
from smplxpp.register.kinematics import BodyPoints, Kinematics, Posture
from smplxpp.register.landmarks import LandmarkModel
from smplxpp.register.normal_equations import NormalEquations
from smplxpp.register.robust import geman_mcclure

# Metres: error of a landmark, and how far it is believed.
_SIGMA, _CUTOFF = 0.015, 0.1
_FAR = 0.25


@dataclass
class Pinned:
    """`sum w |x_k - p_k|^2 / sigma^2` over landmarks, robust once the body stands near.

    Attributes:
        names: of the points. cutoff: metres beyond which a landmark counts less and less.
    """

    names: tuple[str, ...]
    points: Float64[np.ndarray, "K 3"]
    carried: BodyPoints
    mixing: sp.csr_matrix
    cutoff: float = np.inf

    @staticmethod
    def of(body: BodyModel, landmarks: Mapping[str, Float[np.ndarray, " 3"]]) -> Pinned:
        """Landmarks by name; see `LandmarkModel`.

        Raises:
            InputError: a name that the body does not have, a point that is none.
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
        return Pinned(model.names, points, *carried_points(body, model))

    def add(self, equations: NormalEquations, kinematics: Kinematics, posture: Posture) -> None:
        """Add all of them."""
        motion = kinematics.motion(self.carried, posture)
        residual = self.mixing @ motion.points - self.points
        weight = geman_mcclure(np.linalg.norm(residual, axis=1), self.cutoff) / _SIGMA**2
        jacobian = equations.columns.jacobian(motion)
        mixed = np.asarray(self.mixing @ jacobian.reshape(len(jacobian), -1)).reshape(-1, *jacobian.shape[1:])
        root = np.sqrt(weight)[:, None]
        equations.add(0, (mixed * root[..., None]).reshape(-1, mixed.shape[2]), (residual * root).ravel(), shape=True)

    def distance(self, kinematics: Kinematics, posture: Posture) -> float:
        """Mean distance of the landmarks, each at most a quarter of a metre."""
        apart = self.mixing @ kinematics.points(self.carried, posture) - self.points
        return float(np.minimum(np.linalg.norm(apart, axis=1), _FAR).mean())

    def believed(self) -> None:
        """From here on a landmark that is far off is left out."""
        self.cutoff = _CUTOFF
