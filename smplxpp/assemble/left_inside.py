"""What the repair of layers leaves inside, and where on the body: a place in which the body does not fit the scan."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from smplxpp.assemble.layers import TOUCHING, Obstacle
from smplxpp.body.model import BodyModel
from smplxpp.core.mesh import TriangleMesh

_NAMED = 3
_MM = 1e3


@dataclass(frozen=True)
class LeftInside:
    """Vertices of a part that stay inside an inner layer.

    Attributes:
        vertices: how many. depth: of the deepest, metres; 0 for none.
        where: their number by the joint that moves the nearest skin most, largest first.
    """

    vertices: int
    depth: float
    where: dict[str, int]

    @property
    def words(self) -> str:
        """Number, depth and places."""
        places = ", ".join(joint.replace("_", " ") for joint in list(self.where)[:_NAMED])
        more = " and others" if len(self.where) > _NAMED else ""
        return f"{self.vertices} vertices, up to {_MM * self.depth:.1f} mm deep, near {places}{more}"


def find_left_inside(
    mesh: TriangleMesh, obstacles: list[Obstacle], body: BodyModel, body_mesh: TriangleMesh
) -> LeftInside:
    """Find the vertices of a repaired part that lie inside any inner layer.

    Args:
        body, body_mesh: whose skin says where; the model, and its surface in the part's pose.
    """
    depth = np.zeros(mesh.vertex_count)
    for obstacle in obstacles:
        depth = np.maximum(depth, -obstacle.distance(mesh.vertices, mesh.vertex_normals)[0])
    inside = np.flatnonzero(depth > TOUCHING)
    if not len(inside):
        return LeftInside(0, 0.0, {})
    return LeftInside(len(inside), float(depth.max()), joints_near(mesh.vertices[inside], body, body_mesh))


def joints_near(points: Float[np.ndarray, "N 3"], body: BodyModel, body_mesh: TriangleMesh) -> dict[str, int]:
    """Count points by the joint that moves the nearest skin most, the largest number first."""
    nearest = cKDTree(body_mesh.vertices).query(points)[1]
    counts = np.bincount(body.weights[nearest].argmax(axis=1), minlength=body.joint_count)
    order = np.argsort(-counts, kind="stable")[: np.count_nonzero(counts)]
    return {body.joint_names[k]: int(counts[k]) for k in order}
