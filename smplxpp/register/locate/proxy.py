"""What of a body is compared with a bare surface: points, each with its normal and what usually covers it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.body import BodyModel
from smplxpp.core.mesh import normalize_rows
from smplxpp.register.kinematics import BodyPoints, Kinematics, Posture

_FINGERS = ("index", "middle", "pinky", "ring", "thumb")


class Region(IntEnum):
    """What covers a place of the body, mostly."""

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
    """N points of a body.

    Attributes:
        points: as the kinematics pose them. normals: at rest on the mean shape. region: of each point.
        limb: the joint of most weight.
    """

    points: BodyPoints
    normals: Float64[np.ndarray, "N 3"]
    region: Int64[np.ndarray, " N"]
    limb: Int64[np.ndarray, " N"]

    @staticmethod
    def of(body: BodyModel, count: int, *, seed: int = 0) -> BodyProxy:
        """About `count` vertices, evenly over the surface; none of eyes, teeth and tongue."""
        index = even_vertices(body, count, seed)
        mesh = body.mesh()
        return BodyProxy(
            BodyPoints.of_vertices(body, index),
            mesh.vertex_normals[index],
            regions(body)[index],
            np.argmax(body.weights[index], axis=1),
        )

    def posed(self, kinematics: Kinematics, posture: Posture) -> tuple[np.ndarray, np.ndarray]:
        """Points and unit normals of a posture."""
        turned = (self.points.weights @ posture.turned.reshape(-1, 9)).reshape(-1, 3, 3)
        normals = normalize_rows(np.einsum("nxy,ny->nx", turned, self.normals))
        return kinematics.points(self.points, posture), normals

    def select(self, rows: np.ndarray) -> BodyProxy:
        """Some of the points."""
        return BodyProxy(self.points.select(rows), self.normals[rows], self.region[rows], self.limb[rows])


def outer_vertices(body: BodyModel) -> Int64[np.ndarray, " n"]:
    """Vertices that a scan can show: no eyes, teeth and tongue."""
    hidden = [k for k, name in enumerate(body.part_label_names) if any(w in name for w in ("eye", "teeth", "tongue"))]
    return np.flatnonzero(~np.isin(body.part_labels, hidden))


def even_vertices(body: BodyModel, count: int, seed: int) -> Int64[np.ndarray, " n"]:
    """`count` vertices drawn by the area about them, in increasing order."""
    mesh = body.mesh()
    area = np.bincount(mesh.faces.ravel(), np.repeat(mesh.face_areas / 3, 3), minlength=body.vertex_count)
    outer = outer_vertices(body)
    share = area[outer] / area[outer].sum()
    drawn = np.random.default_rng(seed).choice(outer, min(count, int((share > 0).sum())), replace=False, p=share)
    return np.sort(drawn)


def regions(body: BodyModel) -> Int64[np.ndarray, " V"]:
    """The region of every vertex, by its joint of most weight; the face is what of the head lies before the ears."""
    names = np.array(body.joint_names)
    limb = names[np.argmax(body.weights, axis=1)]
    out = np.full(body.vertex_count, Region.TRUNK, dtype=np.int64)
    joints = body.joint_regressor @ body.v_template
    place = {str(name): k for k, name in enumerate(names)}
    for k, name in enumerate(limb):
        part = str(name).removeprefix("left_").removeprefix("right_")
        if any(part.startswith(finger) for finger in _FINGERS) or part == "hand":
            out[k] = Region.HAND
        elif part == "wrist":
            out[k] = Region.HAND
        elif part in ("ankle", "foot"):
            out[k] = Region.FOOT
        elif part in ("hip", "knee"):
            out[k] = Region.LEG
        elif part in ("shoulder", "elbow"):
            out[k] = Region.ARM
        elif part == "neck":
            out[k] = Region.NECK
        elif part in ("head", "jaw") or "eye" in part:
            out[k] = Region.SCALP
    head = joints[place["head"]]
    size = body.v_template[:, 1].max() - head[1]
    # Brows to chin, before the ears.
    v = body.v_template
    front = (v[:, 2] > head[2] + 0.15 * size) & (v[:, 1] < head[1] + 0.52 * size)
    out[(out == Region.SCALP) & front] = Region.FACE
    return out
