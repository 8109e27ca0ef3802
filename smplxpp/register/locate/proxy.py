"""Sample a body for comparison with a bare surface: points with normals and the region that each belongs to."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.body import BodyModel
from smplxpp.core.mesh import normalize_rows
from smplxpp.register.kinematics import BodyPoints, Kinematics, Posture
from smplxpp.register.landmarks import is_finger, visible_vertices


class Region(IntEnum):
    """Regions of the body that differ in what usually covers them."""

    HAND = 0
    FACE = 1
    SCALP = 2
    FOOT = 3
    NECK = 4
    ARM = 5
    LEG = 6
    TRUNK = 7


@dataclass(frozen=True, eq=False)
class BodyProxy:
    """N points of a body with what correspondences need.

    Attributes:
        points: points that the kinematics pose.
        normals: unit normals of the mean shape at rest.
        region: `Region` of each point.
        limb: index of the joint of largest skinning weight.
    """

    points: BodyPoints
    normals: Float64[np.ndarray, "N 3"]
    region: Int64[np.ndarray, " N"]
    limb: Int64[np.ndarray, " N"]

    @staticmethod
    def of(body: BodyModel, count: int, *, seed: int = 0) -> BodyProxy:
        """Draw about `count` visible vertices, evenly over the surface."""
        index = even_vertices(body, count, seed)
        mesh = body.mesh()
        return BodyProxy(
            BodyPoints.of_vertices(body, index),
            mesh.vertex_normals[index],
            regions(body)[index],
            np.argmax(body.weights[index], axis=1),
        )

    def posed(self, kinematics: Kinematics, posture: Posture) -> tuple[np.ndarray, np.ndarray]:
        """Return the points and unit normals in a posture."""
        blended = (self.points.weights @ posture.rotations.reshape(-1, 9)).reshape(-1, 3, 3)
        normals = normalize_rows(np.einsum("nxy,ny->nx", blended, self.normals))
        return kinematics.points(self.points, posture), normals

    def select(self, rows: np.ndarray) -> BodyProxy:
        """Return some of the points in the given order."""
        return BodyProxy(self.points.select(rows), self.normals[rows], self.region[rows], self.limb[rows])


def even_vertices(body: BodyModel, count: int, seed: int) -> Int64[np.ndarray, " n"]:
    """Draw `count` visible vertices with probabilities in proportion to their area; return them in ascending order."""
    mesh = body.mesh()
    area = np.bincount(mesh.faces.ravel(), np.repeat(mesh.face_areas / 3, 3), minlength=body.vertex_count)
    outer = visible_vertices(body)
    share = area[outer] / area[outer].sum()
    drawn = np.random.default_rng(seed).choice(outer, min(count, int((share > 0).sum())), replace=False, p=share)
    return np.sort(drawn)


def regions(body: BodyModel) -> Int64[np.ndarray, " V"]:
    """Return the region of every vertex by its joint of largest weight; the face is the part of the head before the
    ears, from brows to chin."""
    of_joint = np.array([_region_of(name) for name in body.joint_names], dtype=np.int64)
    out = of_joint[np.argmax(body.weights, axis=1)]
    # The face, in fractions of the height from the head joint to the crown.
    head = (body.joint_regressor @ body.v_template)[body.joint_names.index("head")]
    size = body.v_template[:, 1].max() - head[1]
    v = body.v_template
    front = (v[:, 2] > head[2] + 0.15 * size) & (v[:, 1] < head[1] + 0.52 * size)
    out[(out == Region.SCALP) & front] = Region.FACE
    return out


def _region_of(joint: str) -> Region:
    """Return the region of the vertices that a joint carries."""
    part = joint.removeprefix("left_").removeprefix("right_")
    if is_finger(part) or part in ("hand", "wrist"):
        return Region.HAND
    if part in ("head", "jaw") or "eye" in part:
        return Region.SCALP
    of_parts = {"ankle": Region.FOOT, "foot": Region.FOOT, "hip": Region.LEG, "knee": Region.LEG}
    of_parts |= {"shoulder": Region.ARM, "elbow": Region.ARM, "neck": Region.NECK}
    return of_parts.get(part, Region.TRUNK)
