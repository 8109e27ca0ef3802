"""A scan as a source of colour: its textures, the colours of its vertices, its labels, and its nearest points."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import igl
import numpy as np
from jaxtyping import Bool, Float64, Int64, Integer, UInt8
from scipy.spatial import cKDTree

from smplxpp.core import TriangleMesh
from smplxpp.core.mesh_files.raw_mesh import FacePictures, RawMesh
from smplxpp.core.mesh_files.texture import sample_bilinear
from smplxpp.core.signed_distance import barycentric_coordinates


@dataclass(frozen=True, eq=False)
class PaintedScan:
    """The scan of a template, metres, in the pose in which it was scanned.

    Attributes:
        mesh: the surface.
        colors: sRGB of its vertices.
        labels: of its faces.
        pictures: its textures, a row a face of `mesh`; None: the vertices have all its colours.
    """

    mesh: TriangleMesh
    colors: UInt8[np.ndarray, "N 3"]
    labels: Integer[np.ndarray, " M"]
    pictures: FacePictures | None = None
    _decoded: dict[int, np.ndarray] = field(default_factory=dict, init=False, repr=False)

    def colors_at(
        self, face: Int64[np.ndarray, " T"], barycentric: Float64[np.ndarray, "T 3"]
    ) -> UInt8[np.ndarray, "T 3"]:
        """Return the sRGB colour of points on faces: of the texture, or between the vertices where there is none."""
        corners = self.colors[self.mesh.faces[face]].astype(np.float32)
        out = np.rint(np.einsum("tk,tkc->tc", barycentric.astype(np.float32), corners)).astype(np.uint8)
        if self.pictures is None:
            return out
        picture = self.pictures.picture[face]
        for k in np.unique(picture[picture >= 0]):
            rows = np.flatnonzero(picture == k)
            uv = np.einsum("tk,tkd->td", barycentric[rows], self.pictures.uv[face[rows]])
            out[rows] = sample_bilinear(self._picture(int(k)), uv, wrap=self.pictures.wraps[k])
        return out

    def _picture(self, k: int) -> np.ndarray:
        # One texture is kept; few scans have more, and all parts read each.
        if k not in self._decoded:
            assert self.pictures is not None
            self._decoded.clear()
            self._decoded[k] = self.pictures.load[k]()
        return self._decoded[k]

    def labelled(self, label: int) -> LabelledSurface | None:
        """Return the faces with a label for nearest-point queries; None where there are none."""
        chosen = np.flatnonzero((self.labels == label) & (self.mesh.face_areas > 0))
        return LabelledSurface(self.mesh, chosen) if len(chosen) else None


@dataclass(frozen=True, eq=False)
class LabelledSurface:
    """Some faces of a scan and their search tree, so that a sleeve does not take the colour of the hand.

    Attributes:
        mesh: the whole scan.
        faces: the faces that are searched.
    """

    mesh: TriangleMesh
    faces: Int64[np.ndarray, " m"]

    @cached_property
    def _tree(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(self.mesh.vertices, self.mesh.faces[self.faces])
        return tree

    @cached_property
    def edge(self) -> float:
        """Length of a typical edge, metres."""
        corners = self.mesh.triangles[self.faces]
        return float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))

    @cached_property
    def _rim(self) -> Bool[np.ndarray, "m 3"]:
        """Whether the edge opposite each corner ends these faces: another label or a hole lies behind it."""
        corners = self.mesh.faces[self.faces]
        ends = np.sort(np.stack([np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1)], axis=2), axis=2)
        key = ends[..., 0] * self.mesh.vertex_count + ends[..., 1]
        _, place, count = np.unique(key, return_inverse=True, return_counts=True)
        return (count[place] == 1).reshape(key.shape)

    @cached_property
    def inner(self) -> Bool[np.ndarray, " M"]:
        """Which faces of the whole scan lie well within the label, where no other one's colour has run in."""
        # Metres from the rim of a label within which colours may be its neighbour's: labels and skins' edges
        # are that exact.
        run_in = 0.012
        least_inner = 0.1  # share of a label's faces
        corners = self.mesh.faces[self.faces]
        inside = np.zeros(self.mesh.face_count, dtype=bool)
        inside[self.faces] = True
        ends = np.unique(np.stack([np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1)], axis=2)[self._rim])
        if len(ends):
            distance = cKDTree(self.mesh.vertices[ends]).query(self.mesh.face_centers[self.faces])[0]
            inside[self.faces] = (distance > run_in) & ~np.isin(corners, ends).any(axis=1)
        # A label that is all rim, such as a strap, has nothing better than its rim.
        if inside.sum() < least_inner * len(self.faces):
            inside[self.faces] = True
        return inside

    def nearest(
        self, points: Float64[np.ndarray, "T 3"]
    ) -> tuple[Float64[np.ndarray, " T"], Int64[np.ndarray, " T"], Float64[np.ndarray, "T 3"], Bool[np.ndarray, " T"]]:
        """Find the nearest points: distance in metres, face of the scan, barycentric coordinates, whether on a rim."""
        squared, found, closest = self._tree.squared_distance(
            self.mesh.vertices, self.mesh.faces[self.faces], np.ascontiguousarray(points)
        )
        found = np.asarray(found).reshape(-1)
        face = self.faces[found]
        barycentric = np.clip(barycentric_coordinates(closest, self.mesh.triangles[face]), 0.0, 1.0)
        # A coordinate of zero places the point on the edge opposite that corner.
        rim = ((barycentric < 1e-6) & self._rim[found]).any(axis=1)
        return np.sqrt(np.asarray(squared).reshape(-1)), face, barycentric, rim


def pictures_of(
    raw: RawMesh, mesh: TriangleMesh, source_vertex: Integer[np.ndarray, " N"], source_face: Integer[np.ndarray, " M"]
) -> FacePictures | None:
    """Return a file's textures for the faces of the repaired scan; None where the file has none.

    The repair may have turned a face's corners round, which their places in the file tell.

    Args:
        raw: the scan's file.
        mesh: the repaired scan.
        source_vertex: vertex of the file that each vertex comes from.
        source_face: face of the file that each face comes from.
    """
    if raw.pictures is None or len(source_face) != mesh.face_count or (source_face < 0).any():
        return None
    there = raw.vertices[raw.faces[source_face]]
    here = raw.vertices[source_vertex[mesh.faces]]
    straight, turned = (np.square(here - order).sum(axis=(1, 2)) for order in (there, there[:, ::-1]))
    uv = raw.pictures.uv[source_face]
    uv = np.where((turned < straight)[:, None, None], uv[:, ::-1], uv)
    return FacePictures(uv, raw.pictures.picture[source_face], raw.pictures.load, raw.pictures.wraps)
