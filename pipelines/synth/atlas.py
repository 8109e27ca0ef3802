"""The person's colours, painted once onto small cells of every face: to look one up costs less than to compute it."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipelines.synth.person import Person
from smplxpp.core.mesh import TriangleMesh

_CHUNK = 400_000  # cells that are painted at once


@dataclass(frozen=True, eq=False)
class Atlas:
    """Colours of M faces, each cut into n^2 congruent triangles, every one of the colour at its middle.

    Attributes:
        divisions: n of each face.
        first: where each face's cells start.
        color: sRGB of all cells.
    """

    divisions: Int[np.ndarray, " M"]
    first: Int[np.ndarray, " M"]
    color: UInt8[np.ndarray, "C 3"]

    def colors(self, face: Int[np.ndarray, " P"], barycentric: Float[np.ndarray, "P 3"]) -> UInt8[np.ndarray, "P 3"]:
        """Return the colours of the cells that hold points on faces."""
        n = self.divisions[face]
        row, column, rest = (np.clip((n * barycentric[:, k]).astype(np.int32), 0, n - 1) for k in range(3))
        # Rounding may take a point over its row's end.
        column = np.minimum(column, n - 1 - row)
        turned = (row + column + rest < n - 1) & (row + column < n - 1)
        # Row i has 2 (n - i) - 1 cells, upright and turned ones in turn.
        return self.color[self.first[face] + row * (2 * n - row) + 2 * column + turned]


def paint_atlas(person: Person, *, cell: float, face_cell: float, shown: Int[np.ndarray, " m"] | None = None) -> Atlas:
    """Paint the person's colours.

    Args:
        person: whose T-pose is painted.
        cell: side of a cell's square of the same area, metres.
        face_cell: the same from the neck's joint upwards.
        shown: faces that are painted; the others have one black cell. None: all.
    """
    mesh = TriangleMesh(person.tpose.vertices, person.tpose.faces)
    body = person.body
    joints = body.joint_regressor @ mesh.vertices[: body.vertex_count]
    above = mesh.face_centers[:, 1] > joints[body.joint_names.index("neck"), 1]
    sides = np.where(above, face_cell, cell)
    divisions = np.maximum(np.ceil(np.sqrt(mesh.face_areas) / sides), 1).astype(np.int32)
    painted = np.arange(mesh.face_count) if shown is None else shown
    hidden = np.ones(mesh.face_count, dtype=bool)
    hidden[painted] = False
    divisions[hidden] = 1
    count = divisions.astype(np.int64) ** 2
    first = np.cumsum(count) - count
    color = np.zeros((int(count.sum()), 3), np.uint8)

    def paint(faces: Int[np.ndarray, " F"]) -> None:
        cells = np.repeat(faces, count[faces])
        place = np.arange(len(cells)) - np.repeat(np.cumsum(count[faces]) - count[faces], count[faces])
        bary = _middles(place, divisions[cells])
        corners = mesh.faces[cells]
        points = np.einsum("pk,pkx->px", bary, mesh.vertices[corners]).astype(np.float32)
        nearest = corners[np.arange(len(corners)), np.argmax(bary, axis=1)]
        color[first[cells] + place] = person.colors(points, person.face_part[cells], person.vertex_label[nearest])

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(paint, _chunks(painted, count)))
    return Atlas(divisions, first, color)


def _middles(place: Int[np.ndarray, " P"], n: Int[np.ndarray, " P"]) -> Float[np.ndarray, "P 3"]:
    """Return the barycentric middles of cells by their place among their face's n^2."""
    # Row i starts at i (2 n - i): the larger root is the row's number, up to rounding.
    row = np.floor(n - np.sqrt(np.maximum(n.astype(np.float64) ** 2 - place, 0.0)) + 1e-9).astype(np.int64)
    inside = place - row * (2 * n - row)
    column, turned = inside // 2, inside % 2
    third = np.where(turned == 1, 2.0, 1.0) / 3.0
    a, b = (row + third) / n, (column + third) / n
    return np.stack([a, b, 1.0 - a - b], axis=1)


def _chunks(faces: Int[np.ndarray, " F"], count: Int[np.ndarray, " M"]) -> Iterator[Int[np.ndarray, " f"]]:
    """Cut a list of faces where about `_CHUNK` cells are full."""
    number = np.cumsum(count[faces]) // _CHUNK
    return iter(np.split(faces, np.flatnonzero(np.diff(number)) + 1))
