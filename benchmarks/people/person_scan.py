"""PersonScan: a scan of a clothed person and all that is true of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from smplxpp.body import BodyModel
from smplxpp.clean.units import convert_points
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams


@dataclass(frozen=True, eq=False)
class PersonScan:
    """A scan as its file would hold it, and its truth, which is in metres, +Y up, whatever the file's units.

    Attributes:
        name: of the person, and of the variant if it is one.
        mesh: one outer surface, in `units` and with `up` upwards (metres and "y" but for variants).
        colors: sRGB a vertex; None for a scan without colours.
        face_labels: ids of `smplxpp.core.labels`, of the layer that each face shows.
        seen: whether a face lies on a layer that the scanner saw; false on webs and where it guessed.
        params: one row that gives `body_vertices` with `load_body()`.
        body_vertices: of the open body under the clothes. joints: its joints.
        units, up: of `mesh`, as `smplxpp.clean.convert_points` has them.
    """

    name: str
    mesh: TriangleMesh
    colors: UInt8[np.ndarray, "N 3"] | None
    face_labels: Int[np.ndarray, " M"]
    seen: Bool[np.ndarray, " M"]
    params: BodyParams
    body_vertices: Float[np.ndarray, "V 3"]
    joints: Float[np.ndarray, "J 3"]
    units: str = "m"
    up: str = "y"

    @staticmethod
    def of(
        body: BodyModel,
        params: BodyParams,
        *,
        name: str,
        mesh: TriangleMesh,
        colors: UInt8[np.ndarray, "N 3"] | None,
        face_labels: Int[np.ndarray, " M"],
        seen: Bool[np.ndarray, " M"],
    ) -> PersonScan:
        """A scan in metres, +Y up, its body made of one row of parameters."""
        posed = body.forward(params)
        return PersonScan(name, mesh, colors, face_labels, seen, params, posed.vertices[0], posed.joints[0])

    def as_read(self) -> PersonScan:
        """The same with its mesh in metres, +Y up."""
        vertices = convert_points(self.mesh.vertices, units=self.units, up=self.up)
        return replace(self, mesh=self.mesh.with_vertices(vertices), units="m", up="y")


def face_majority(vertex_labels: Int[np.ndarray, " N"], faces: Int[np.ndarray, "M 3"]) -> Int[np.ndarray, " M"]:
    """The label of most corners; of the first where all differ."""
    corner = np.asarray(vertex_labels, dtype=np.int64)[faces]
    return np.where(corner[:, 1] == corner[:, 2], corner[:, 1], corner[:, 0])
