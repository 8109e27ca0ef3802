"""Match vertices of a template to the points of true surfaces that they are, through all frames."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Float, Int

from pipelines.stages.scene import TrainScene
from smplxpp.core import BodyParams, TriangleMesh


@dataclass(frozen=True, eq=False)
class SamePoints:
    """K vertices of the template and their places on true surfaces whose vertices are the same points in all frames.

    Attributes:
        own: the template's vertices.
        corners: vertices of the true surface's triangles on which they lie.
        weights: barycentric coordinates in these triangles.
        vertices: number of vertices of the true surface.
    """

    own: Int[np.ndarray, " K"]
    corners: Int[np.ndarray, "K 3"]
    weights: Float[np.ndarray, "K 3"]
    vertices: int

    @staticmethod
    def found(
        scene: TrainScene, reference: BodyParams, own: Int[np.ndarray, " N"], *, within: float = 2e-3
    ) -> SamePoints | None:
        """Match vertices in the frame that the template was built from; None without its truth or any match.

        Args:
            scene: with the capture and the template.
            reference: parameters of that frame.
            own: vertices to match.
            within: metres from the true surface; vertices farther away are left out.
        """
        truth = None if scene.built_frame is None else scene.capture.truth_mesh(scene.built_frame)
        if truth is None:
            return None
        points = np.ascontiguousarray(scene.template.pose(reference)[0][own])
        squared, face, near = igl.point_mesh_squared_distance(points, truth.vertices, truth.faces)[:3]
        close = squared < within**2
        if not close.any():
            return None
        corners = truth.faces[face[close]]
        a, b, c = (np.ascontiguousarray(truth.vertices[corners[:, k]]) for k in range(3))
        weights = igl.barycentric_coordinates(np.ascontiguousarray(near[close]), a, b, c)
        return SamePoints(own[close], corners, weights, len(truth.vertices))

    def of(self, truth: TriangleMesh) -> Float[np.ndarray, "K 3"]:
        """Return where the vertices are in a frame with this true surface, metres."""
        return np.einsum("kc,kcd->kd", self.weights, truth.vertices[self.corners])
