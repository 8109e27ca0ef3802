"""How badly a body explains a surface, and the surface the body: one length for all candidates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from smplxpp.core.surface_points import SurfacePoints, position_normal_features
from smplxpp.register.kinematics import Kinematics, Posture
from smplxpp.register.locate.dressed import OuterBody
from smplxpp.register.locate.proxy import BodyProxy, Region

# Metres: what is farther counts as so far; clothes may stand off so much for nothing, and inside counts double.
_CAP, _LOOSE = 0.04, 0.025
_BARE = (Region.HAND, Region.FACE)
# Parts that a person's scan shows, by their joints.
PARTS = {
    "head": "head",
    "left hand": "left_wrist",
    "right hand": "right_wrist",
    "left forearm": "left_elbow",
    "right forearm": "right_elbow",
    "left lower leg": "left_knee",
    "right lower leg": "right_knee",
    "left foot": "left_ankle",
    "right foot": "right_ankle",
}


@dataclass(frozen=True)
class Misfit:
    """Metres, lower is better.

    Attributes:
        surface: of the surface's points to the body. bare: of hands, face and feet of the body to the surface.
        covered: share of the surface that the body explains. shown: share of the body's hands, face and feet there.
        parts: share of each of `PARTS` that the surface has.
    """

    surface: float
    bare: float
    covered: float
    shown: float
    parts: Mapping[str, float]

    @property
    def total(self) -> float:
        """Both directions."""
        return 0.5 * (self.surface + self.bare)


def misfit(
    kinematics: Kinematics, outer: OuterBody, proxy: BodyProxy, surface: SurfacePoints, posture: Posture
) -> Misfit:
    """Measure a posture against a surface."""
    found = outer.match(outer.mesh(posture), surface)
    tight = np.isin(found.region, _BARE)
    loose = np.where(found.distance < 0, -2.0 * found.distance, np.maximum(found.distance - _LOOSE, 0.0))
    each = np.minimum(np.where(tight, np.abs(found.distance), loose), _CAP)
    each[found.facing < 0.0] = _CAP
    points, normals = proxy.posed(kinematics, posture)
    shown = np.isin(proxy.region, (*_BARE, Region.FOOT))
    _, nearest = surface.tree.query(position_normal_features(points, normals))
    apart = points - surface.points[nearest]
    along = np.einsum("nx,nx->n", apart, surface.normals[nearest])
    distance = np.linalg.norm(apart, axis=1)
    off = np.minimum(np.where(distance < _CAP, np.abs(along), distance), _CAP)
    facing = np.einsum("nx,nx->n", normals, surface.normals[nearest])
    off[facing < 0.3] = _CAP
    return Misfit(
        float(each.mean()),
        float(off[shown].mean()),
        float((each < _CAP).mean()),
        float((off[shown] < _CAP).mean()),
        {name: float((off[rows] < _CAP).mean()) for name, rows in _rows_of_parts(kinematics, proxy).items()},
    )


def _rows_of_parts(kinematics: Kinematics, proxy: BodyProxy) -> dict[str, np.ndarray]:
    """Points of each part: those of its joint, and all that hangs on it where it is an end."""
    names = list(kinematics.body.joint_names)
    out = {}
    for part, joint in PARTS.items():
        index = names.index(joint)
        whole = part.split()[-1] in ("head", "hand", "foot")
        limbs = kinematics.hangs_on[:, index] if whole else np.arange(len(names)) == index
        out[part] = np.flatnonzero(limbs[proxy.limb])
    return out
