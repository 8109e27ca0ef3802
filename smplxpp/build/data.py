"""Data in which the steps of a build meet. It imports little, so that what reads it depends on little."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64, Integer, UInt8

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, InputError, SkinWeights, TriangleMesh
from smplxpp.core.errors import one_line


@dataclass(frozen=True, eq=False)
class PreparedScan:
    """The scan that a template is built from: metres, +Y up, repaired, smoothed where it was rough.

    Attributes:
        mesh: the surface.
        colors: sRGB of its vertices; `GREY` throughout for a scan without colours.
        source_vertex: vertex of the user's file that each vertex comes from.
        source_face: face of the user's file that each face comes from, -1 for a point cloud's surface.
    """

    mesh: TriangleMesh
    colors: UInt8[np.ndarray, "N 3"]
    source_vertex: Integer[np.ndarray, " N"]
    source_face: Integer[np.ndarray, " M"]

    @property
    def own_colors(self) -> UInt8[np.ndarray, "N 3"] | None:
        """The colours, None where they are all the same: then the scan has none."""
        return self.colors if self.colors.std() else None


@dataclass(frozen=True, eq=False)
class PosedFit:
    """The fitted body of one frame; see `PosedBody` for the arrays.

    Attributes:
        mesh: posed.
        at_rest: in the rest pose, with its shape.
        joints: posed joints.
        rest_joints: joints before posing.
        posed_from_rest: transforms of the joints.
    """

    mesh: TriangleMesh
    at_rest: TriangleMesh
    joints: Float64[np.ndarray, "J 3"]
    rest_joints: Float64[np.ndarray, "J 3"]
    posed_from_rest: Float64[np.ndarray, "J 4 4"]


@dataclass(frozen=True, eq=False)
class LocatedInScan:
    """The body found in a scan: a place where a registration begins, and where skin shows.

    Attributes:
        params: one frame.
        labels: certain labels of the scan's vertices, -1 elsewhere.
        bare: the body's vertices that nothing covers.
        scale: factor from the scan as it was read to one whose body has the stated stature; 1 without a stature.
    """

    params: BodyParams
    labels: Int64[np.ndarray, " N"]
    bare: Bool[np.ndarray, " V"]
    scale: float = 1.0

    def labels_of(self, vertices: int) -> Int64[np.ndarray, " N"] | None:
        """Return the labels for a scan of this many vertices; None where it was another scan."""
        return self.labels if len(self.labels) == vertices else None

    def bare_of(self, body: BodyModel) -> Bool[np.ndarray, " V"]:
        """Return the bare vertices of this body.

        Raises:
            InputError: it was found with another body.
        """
        if self.bare.shape != (body.vertex_count,):
            raise InputError(
                "body found in the scan: bare",
                expected=f"shape ({body.vertex_count},)",
                received=f"shape {self.bare.shape}",
                remedy="build again with the same --body",
            )
        return self.bare


@dataclass(frozen=True, eq=False)
class Part:
    """A loose part of the scan in its pose: a garment, hair, shoes.

    Attributes:
        mesh: in the scan's frame.
        label: id of its label.
        source_vertex: vertex of the scan that each vertex stands for.
        colors: sRGB of its vertices.
    """

    mesh: TriangleMesh
    label: int
    source_vertex: Integer[np.ndarray, " n"]
    colors: UInt8[np.ndarray, "n 3"]

    __repr__ = one_line


@dataclass(frozen=True, eq=False)
class RestPart:
    """A loose part in the T-pose.

    Attributes:
        posed: the part in the scan's pose, without bridges.
        weights: its skin weights.
        vertices: its vertices in the T-pose.
    """

    posed: Part
    weights: SkinWeights
    vertices: Float[np.ndarray, "n 3"]
