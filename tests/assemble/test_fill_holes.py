"""Holes of a cut are filled in the T-pose with harmonic weights and colours; openings and sails are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from smplxpp.assemble import CanonicalPart, FillHolesConfig, cut_holes, cut_slits, fill_holes, part_legs
from smplxpp.assemble.patch import drape_patches
from smplxpp.core import UPPER, InputError, SkinWeights, TriangleMesh
from smplxpp.core.topology import border_loops, edge_groups

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
    filled, report = fill_holes(part, holes)
    count = part.mesh.vertex_count
    assert report.holes == report.closed == 1 and report.faces == filled.mesh.face_count - part.mesh.face_count
    assert report.area == pytest.approx(25 * CELL**2, rel=0.2)
    assert len(border_loops(part.mesh.faces)) == 3 and len(border_loops(filled.mesh.faces)) == 2
    np.testing.assert_array_equal(filled.mesh.vertices[:count], part.mesh.vertices)
    np.testing.assert_array_equal(filled.mesh.faces[: part.mesh.face_count], part.mesh.faces)
    assert (filled.scan_index[count:] == -1).all() and (filled.scan_index[:count] == part.scan_index).all()
    # Weights and colours are linear along the tube; so are harmonic ones between them.
    height = filled.mesh.vertices[count:, 1] / (CELL * (ROWS - 1))
    np.testing.assert_allclose(filled.weights.dense()[count:, 0], height, atol=0.03)
    np.testing.assert_allclose(filled.vertex_colors[count:, 0], 255 * height, atol=8)
    np.testing.assert_allclose(filled.weights.dense().sum(axis=1), 1.0, atol=1e-12)
    assert not filled.weights.matched[count:].any() and np.isnan(filled.weights.distance[count:]).all()


def test_a_cut_that_reaches_an_opening_is_part_of_it(tube):
    part = without(tube, ((16, 20), (3, 8)))
    assert holes_of(part, tube) == []
    filled, report = fill_holes(part, [])
    assert filled is part and report.holes == 0


def slits_of(part: CanonicalPart, before: CanonicalPart, **options) -> list[np.ndarray]:
    return cut_slits(before.mesh, before.scan_index, part.mesh, part.scan_index, **options)


def test_a_cut_from_the_opening_is_closed_and_the_opening_stays(tube):
    """As where a sleeve was fused with the side up from its cuff: the cuff is a circle again."""
    part = without(tube, ((14, 20), (3, 8)))
    (slit,) = slits_of(part, tube)
    filled, report = fill_holes(part, [slit])
    assert report.closed == 1 and report.area == pytest.approx(30 * CELL**2, rel=0.25)
    before, after = (border_loops(one.mesh.faces) for one in (tube, filled))
    assert len(after) == len(before) == 2
    # The straight edge over the slit is divided into as many edges as it stands for, so that the patch can bend there.
    assert sum(map(len, after)) == sum(map(len, before))
    assert edge_groups(filled.mesh.faces)[2].max() == 2


def test_a_cut_from_one_opening_to_the_other_is_closed_along_its_whole_length(tube):
    """A side seam that is gone: two runs, joined across both openings."""
    part = without(tube, ((0, 20), (3, 8)))
    (slit,) = slits_of(part, tube)
    filled, report = fill_holes(part, [slit])
    assert report.closed == 1 and report.area == pytest.approx(100 * CELL**2, rel=0.25)
    assert len(border_loops(filled.mesh.faces)) == 2 and edge_groups(filled.mesh.faces)[2].max() == 2


def test_trouser_legs_that_were_cut_apart_get_their_inner_sides_and_are_not_sewn_together(tube):
    """Wide legs were closed in front and behind instead, like a skirt, because their hems' ends were far apart."""
    # Scaled to half a metre about; cut in front and behind from the hem up, and the halves moved apart.
    large = replace(tube, mesh=tube.mesh.with_vertices(4.0 * tube.mesh.vertices))
    part = without(large, ((0, 14), (9, 11)), ((0, 14), (29, 31)))
    x, y, _ = part.mesh.vertices.T
    below = y < 4.0 * CELL * 14.5
    moved = part.mesh.vertices + np.where(below, 0.05 * np.sign(x), 0.0)[:, None] * [1.0, 0.0, 0.0]
    part = replace(part, mesh=part.mesh.with_vertices(moved))
    old = np.isin(part.scan_index, large.scan_index[np.unique(large.mesh.border_edges)])
    parted, walls = part_legs(part, old, np.sign(x) * below)
    assert len(walls) == 2 and parted.mesh.vertex_count > part.mesh.vertex_count
    filled, report = fill_holes(parted, walls, config=FillHolesConfig(width=2.0))
    assert report.closed == 2
    # A manifold with a waist and two hems; each wall stays on its own leg's side.
    assert len(border_loops(filled.mesh.faces)) == 3 and edge_groups(filled.mesh.faces)[2].max() == 2
    added = filled.mesh.vertices[filled.mesh.faces[part.mesh.face_count :]]
    low = added[:, :, 1].max(axis=1) < 0.4
    assert low.any() and (np.abs(added[low][:, :, 0]).min(axis=1) > 0.03).all()
    # A short cut between the thighs is closed across.
    short = without(large, ((0, 4), (9, 11)), ((0, 4), (29, 31)))
    assert part_legs(short, np.zeros(short.mesh.vertex_count, dtype=bool), short.mesh.vertices[:, 0])[1] == []


def test_ends_that_are_far_apart_are_not_joined(tube):
    part = without(tube, ((14, 20), (3, 15)))
    assert slits_of(part, tube, longest=0.05, closing=0.05) == [] and len(slits_of(part, tube)) == 1


def test_where_a_thing_was_taken_off_is_no_opening(tube):
    """A border of the part before any cut, along which the scan shows a thing against it."""
    part = without(tube, ((8, 13), (3, 8)))
    assert holes_of(part, part) == [] and slits_of(part, part) == []
    (rim,) = holes_of(part, tube)
    taken = np.zeros(1000, dtype=bool)
    taken[part.scan_index[rim]] = True
    (hole,) = cut_holes(part.mesh, part.scan_index, part.mesh, part.scan_index, taken=taken)
    np.testing.assert_array_equal(hole, rim)


def test_two_holes_and_the_wide_one_stays(tube):
    part = without(tube, ((8, 12), (3, 7)), ((3, 17), (20, 36)))
    holes = holes_of(part, tube)
    filled, report = fill_holes(part, holes, config=FillHolesConfig(width=0.04))
    assert (report.holes, report.closed) == (2, 1) and len(border_loops(filled.mesh.faces)) == 3
    assert fill_holes(part, holes, config=FillHolesConfig(width=1.0))[1].closed == 2
    same, report = fill_holes(part, holes, config=FillHolesConfig(width=0.0))
    assert same is part and (report.holes, report.closed) == (2, 0)


def test_a_wide_sleeve_that_was_fused_with_the_side_is_closed_without_a_sail():
    """A jacket's sleeve stayed open from armpit to wrist, because its patch was half a millimetre too wide."""
    deep, arm = 0.155, np.linspace(0.0, 0.66, 34)
    # Down the side, up to the armpit and out along the arm; a wall of faces stands along both edges of the strip.
    path = np.concatenate([np.stack([0 * arm, -arm[::-1]], 1), np.stack([arm[1:], 0 * arm[1:]], 1)])
    across = np.linspace(0.0, deep, 8)[1:-1]
    sides = [np.insert(path, 2, z, axis=1) for z in (0.0, deep)]
    ends = [np.insert(np.tile(path[k], (6, 1)), 2, across, axis=1) for k in (-1, 0)]
    rim = np.concatenate([sides[0], ends[0], sides[1][::-1], ends[1][::-1]])
    count = len(rim)
    low, high = np.arange(count), np.arange(count) + count
    faces = [np.stack([low, np.roll(low, -1), high], 1), np.stack([np.roll(low, -1), np.roll(high, -1), high], 1)]
    vertices = np.concatenate([rim, rim + [-0.02, 0.02, 0.0]])
    weights = SkinWeights.from_dense(np.ones((2 * count, 1)))
    colors, index = np.zeros((2 * count, 3), np.uint8), np.arange(2 * count)
    part = CanonicalPart(TriangleMesh(vertices, np.concatenate(faces)), weights, UPPER.id, colors, index)
    filled, report = fill_holes(part, [low])
    assert report.closed == 1 and report.area == pytest.approx(2 * 0.66 * deep, rel=0.05)
    assert np.abs(filled.mesh.vertices[2 * count :, :2]).min(axis=1).max() < 0.04


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
    filled, report = fill_holes(crossed, [hole])
    assert filled is crossed and (report.holes, report.closed) == (1, 0)


@pytest.mark.parametrize("width", [-1.0, np.nan, np.inf])
def test_no_width_is_refused(width):
    with pytest.raises(InputError, match="width"):
        FillHolesConfig(width=width)


def test_a_patch_under_a_sleeve_goes_round_the_arm_and_keeps_its_distance(tube):
    """Two thirds of a sleeve were fused with the side: the least area goes through the arm, on the axis of the tube."""
    part = without(tube, ((4, 16), (3, 30)))
    (hole,) = holes_of(part, tube)
    filled, report = fill_holes(part, [hole], config=FillHolesConfig(width=1.0))
    new = np.arange(filled.mesh.vertex_count) >= part.mesh.vertex_count
    arm = trimesh.creation.capsule(height=0.4, radius=0.05, count=(32, 32))
    turned = arm.vertices[:, [1, 2, 0]] - [0.0, 0.1, 0.0]
    draped = drape_patches(filled, new, TriangleMesh(turned, arm.faces))

    def from_axis(one: CanonicalPart) -> np.ndarray:
        return np.linalg.norm(one.mesh.vertices[new][:, [0, 2]], axis=1)

    assert report.closed == 1 and from_axis(filled).min() < 0.04
    # The rim stands 13.7 mm off; the polyhedron of the arm lies up to half a millimetre in its circle.
    assert from_axis(draped).min() > 0.0637 - 0.0005 and from_axis(draped).max() < 0.0637 + 0.01
    area = draped.mesh.face_areas[new[draped.mesh.faces].any(axis=1)].sum()
    assert area == pytest.approx(27 * 12 * CELL**2, rel=0.08)
    np.testing.assert_array_equal(draped.mesh.vertices[~new], filled.mesh.vertices[~new])
