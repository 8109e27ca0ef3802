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
from smplxpp.metrics.quality import mesh_quality

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


def manifold(mesh: TriangleMesh) -> bool:
    quality = mesh_quality(mesh)
    return quality.nonmanifold_edges == quality.nonmanifold_vertices == 0


def pinched(tube: CanonicalPart, apart: float, right: int = 11) -> tuple[CanonicalPart, CanonicalPart]:
    """The tube without two blocks that touch in a corner, which is two vertices `apart` from each other, as a cut
    leaves it; the same with the corner as one vertex."""
    part = without(tube, ((6, 10), (3, 7)), ((10, 14), (7, right)))
    (corner,) = np.flatnonzero(part.scan_index == 100 + 10 * COLUMNS + 7)
    faces, copy = part.mesh.faces.copy(), part.mesh.vertex_count
    around = np.flatnonzero((faces == corner).any(axis=1))
    columns = part.mesh.vertices[faces[around]].mean(axis=1) - part.mesh.vertices[corner]
    upper = around[columns[:, 1] > 0]
    faces[upper] = np.where(faces[upper] == corner, copy, faces[upper])
    vertices = np.concatenate([part.mesh.vertices, part.mesh.vertices[[corner]] + [0.0, apart, 0.0]])
    dense = part.weights.dense()
    return (
        replace(
            part,
            mesh=TriangleMesh(vertices, faces),
            weights=SkinWeights.from_dense(np.concatenate([dense, dense[[corner]]])),
            vertex_colors=np.concatenate([part.vertex_colors, part.vertex_colors[[corner]]]),
            scan_index=np.concatenate([part.scan_index, part.scan_index[[corner]]]),
        ),
        part,
    )


def test_a_cut_that_touches_itself_is_closed_without_slivers(tube):
    part, whole = pinched(tube, 1e-5)
    holes = holes_of(part, tube)
    assert [len(hole) for hole in holes] == [32]
    darned, said = darn(part, holes)
    assert (said.holes, said.closed) == (1, 1) and len(border_loops(darned.mesh.faces)) == 2
    assert manifold(darned.mesh) and darned.mesh.face_areas.min() > 0.05 * CELL**2
    count = whole.mesh.vertex_count
    np.testing.assert_array_equal(darned.mesh.vertices[:count], whole.mesh.vertices)
    np.testing.assert_array_equal(darned.scan_index[:count], whole.scan_index)
    np.testing.assert_array_equal(darned.weights.dense()[:count], whole.weights.dense())
    lengths = {len(x) for x in (darned.weights.matched, darned.vertex_colors, darned.mesh.vertices, darned.scan_index)}
    assert lengths == {darned.mesh.vertex_count}
    assert said.area == pytest.approx(32 * CELL**2, rel=0.2)


def test_sides_that_have_drawn_apart_stay_two(tube):
    part, _ = pinched(tube, 0.3 * CELL)
    darned, said = darn(part, holes_of(part, tube))
    assert (said.holes, said.closed) == (1, 1) and manifold(darned.mesh)
    np.testing.assert_array_equal(darned.mesh.vertices[: part.mesh.vertex_count], part.mesh.vertices)


def test_sides_stay_two_where_one_of_the_two_holes_would_stay_open(tube):
    """A corner where four borders meet would not be manifold."""
    part, _ = pinched(tube, 1e-5, right=27)
    holes = holes_of(part, tube)
    widths = [darn(part, holes, config=DarnConfig(width=width))[1].closed for width in (0.01, 0.03)]
    assert widths == [0, 1]
    # Both within: joined. The small hole alone within: as two vertices, the whole within or not.
    for width in np.linspace(0.01, 0.03, 21):
        darned, said = darn(part, holes, config=DarnConfig(width=float(width)))
        assert manifold(darned.mesh)
        assert said.closed or darned is part


@pytest.mark.parametrize("width", [-1.0, np.nan, np.inf])
def test_no_width_is_refused(width):
    with pytest.raises(InputError, match="width"):
        DarnConfig(width=width)
