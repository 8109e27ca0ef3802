"""Darning: holes of a cut are closed in the T-pose with harmonic weights and colours; openings and sails are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.assemble import CanonicalPart, DarnConfig, cut_holes, darn
from smplxpp.core.errors import InputError
from smplxpp.core.labels import UPPER
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.core.topology import border_loops

ROWS, COLUMNS, CELL = 21, 40, 0.01


@pytest.fixture
def tube() -> CanonicalPart:
    """A tube of 40 by 20 cells of a centimetre, whose weights go from one joint to the other along it."""
    angle = 2.0 * np.pi * np.arange(COLUMNS) / COLUMNS
    radius = CELL * COLUMNS / (2.0 * np.pi)
    circle = np.stack([radius * np.cos(angle), 0 * angle, radius * np.sin(angle)], axis=1)
    vertices = (circle + CELL * np.arange(ROWS)[:, None, None] * np.array([0.0, 1.0, 0.0])).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(ROWS - 1), np.arange(COLUMNS), indexing="ij")
    a, b = i * COLUMNS + j, i * COLUMNS + (j + 1) % COLUMNS
    faces = np.concatenate([np.stack([a, a + COLUMNS, b], 2), np.stack([b, a + COLUMNS, b + COLUMNS], 2)]).reshape(
        -1, 3
    )
    share = vertices[:, 1] / vertices[:, 1].max()
    weights = SkinWeights.from_dense(np.stack([share, 1.0 - share, 0 * share], axis=1))
    colors = np.stack([255 * share, 255 * (1 - share), 0 * share + 90], axis=1).astype(np.uint8)
    return CanonicalPart(TriangleMesh(vertices, faces), weights, UPPER.id, colors, np.arange(len(vertices)) + 100)


def without(part: CanonicalPart, *cells: tuple[tuple[int, int], tuple[int, int]]) -> CanonicalPart:
    """The tube without the faces of these blocks of rows and columns."""
    row, column = np.divmod(np.tile(np.arange((ROWS - 1) * COLUMNS), 2), COLUMNS)
    cut = np.zeros(part.mesh.face_count, dtype=bool)
    for rows, columns in cells:
        cut |= (row >= rows[0]) & (row < rows[1]) & (column >= columns[0]) & (column < columns[1])
    mesh, used = part.mesh.submesh(~cut)
    weights = SkinWeights.from_dense(part.weights.dense()[used])
    return replace(
        part, mesh=mesh, weights=weights, vertex_colors=part.vertex_colors[used], scan_index=part.scan_index[used]
    )


def holes_of(part: CanonicalPart, before: CanonicalPart) -> list[np.ndarray]:
    return cut_holes(before.mesh, before.scan_index, part.mesh, part.scan_index)


def test_a_hole_is_closed_and_what_was_there_keeps_its_numbers(tube):
    part = without(tube, ((8, 13), (3, 8)))
    holes = holes_of(part, tube)
    darned, said = darn(part, holes)
    count = part.mesh.vertex_count
    assert said.holes == said.closed == 1 and said.faces == darned.mesh.face_count - part.mesh.face_count
    assert said.area == pytest.approx(25 * CELL**2, rel=0.2)
    assert len(border_loops(part.mesh.faces)) == 3 and len(border_loops(darned.mesh.faces)) == 2
    np.testing.assert_array_equal(darned.mesh.vertices[:count], part.mesh.vertices)
    np.testing.assert_array_equal(darned.mesh.faces[: part.mesh.face_count], part.mesh.faces)
    assert (darned.scan_index[count:] == -1).all() and (darned.scan_index[:count] == part.scan_index).all()
    # Weights and colours are linear along the tube; so are harmonic ones between them.
    height = darned.mesh.vertices[count:, 1] / (CELL * (ROWS - 1))
    np.testing.assert_allclose(darned.weights.dense()[count:, 0], height, atol=0.03)
    np.testing.assert_allclose(darned.vertex_colors[count:, 0], 255 * height, atol=8)
    np.testing.assert_allclose(darned.weights.dense().sum(axis=1), 1.0, atol=1e-12)
    assert not darned.weights.matched[count:].any() and np.isnan(darned.weights.distance[count:]).all()


def test_a_cut_that_reaches_an_opening_is_part_of_it(tube):
    part = without(tube, ((16, 20), (3, 8)))
    assert holes_of(part, tube) == []
    darned, said = darn(part, [])
    assert darned is part and said.holes == 0


def test_two_holes_and_the_wide_one_stays(tube):
    part = without(tube, ((8, 12), (3, 7)), ((3, 17), (20, 36)))
    holes = holes_of(part, tube)
    darned, said = darn(part, holes, config=DarnConfig(width=0.04))
    assert (said.holes, said.closed) == (2, 1) and len(border_loops(darned.mesh.faces)) == 3
    assert darn(part, holes, config=DarnConfig(width=1.0))[1].closed == 2
    same, said = darn(part, holes, config=DarnConfig(width=0.0))
    assert same is part and (said.holes, said.closed) == (2, 0)


def test_a_hole_that_cannot_be_closed_stays(tube):
    """Edges of other faces lie across it, both ways."""
    part = without(tube, ((8, 9), (3, 4)))
    (hole,) = holes_of(part, tube)
    across = np.array([[hole[0], hole[2], part.mesh.vertex_count], [hole[1], hole[3], part.mesh.vertex_count + 1]])
    apart = np.array([[0.0, 0.1, 0.0], [0.0, 0.12, 0.0]])
    crossed = replace(
        part,
        mesh=TriangleMesh(np.concatenate([part.mesh.vertices, apart]), np.concatenate([part.mesh.faces, across])),
    )
    darned, said = darn(crossed, [hole])
    assert darned is crossed and (said.holes, said.closed) == (1, 0)


@pytest.mark.parametrize("width", [-1.0, np.nan, np.inf])
def test_no_width_is_refused(width):
    with pytest.raises(InputError, match="width"):
        DarnConfig(width=width)
