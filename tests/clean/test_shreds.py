"""Shreds beside cuts are found: what unposing carries off the body, ribbons, small pieces; cloth without cuts stays."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.clean.shreds import cut_borders, find_shreds
from smplxpp.clean.smooth import smooth_cuts
from smplxpp.core import TriangleMesh
from tests.clean.test_bridges import AXIS, both, cylinder, grid, lifted

CELL = 0.005


@pytest.fixture(scope="module")
def body() -> tuple[TriangleMesh, TriangleMesh]:
    """A trunk and an arm beside it, which goes 30 cm sideways; 1.75 m high, as the thresholds follow the extent."""
    tall = both(*(one.with_vertices(one.vertices * [1, 4.375, 1]) for one in (cylinder(0.15, 0), cylinder(0.05, AXIS))))
    trunk = cylinder(0.15, 0.0).vertex_count
    return tall, tall.with_vertices(lifted(tall.vertices, np.arange(tall.vertex_count) >= trunk))


def cloth(*blocks: tuple[slice, slice]) -> TriangleMesh:
    """Cells of half a centimetre in a plane before the arm: rows upwards from 0.5 m, columns from its axis inwards."""
    kept = np.zeros((60, 60), dtype=bool)
    for rows, columns in blocks:
        kept[rows, columns] = True
    i, j = np.meshgrid(np.arange(61), np.arange(61), indexing="ij")
    whole = grid(np.stack([AXIS - CELL * j, 0.5 + CELL * i, 0.06 + 0.0 * i], axis=2))
    return whole.submesh(np.tile(kept.ravel(), 2))[0]


def every_border(mesh: TriangleMesh) -> np.ndarray:
    return cut_borders(mesh, np.zeros(mesh.vertex_count, dtype=bool))


SLEEVE = (slice(0, 40), slice(0, 12))


def test_a_strip_of_the_side_that_hangs_on_the_sleeve_is_a_shred(body):
    """Its weights mix arm and trunk: at rest it hangs in the air between both, 15 cm off either."""
    part = cloth(SLEEVE, (slice(10, 22), slice(12, 30)))
    strip = part.vertices[:, 0] < AXIS - 12.5 * CELL
    rest = part.with_vertices(lifted(part.vertices, np.where(strip, 0.5, 1.0)))
    found = find_shreds(part, rest, *body, every_border(part))
    of_strip = strip[part.faces].all(axis=1)
    assert found[of_strip].all()
    # The sleeve stays, but for faces at the root of the strip and at its corners.
    assert found[~strip[part.faces].any(axis=1)].mean() < 0.05
    # No border is a cut: nothing is a shred, however it is drawn out.
    assert not find_shreds(part, rest, *body, np.zeros(part.vertex_count, dtype=bool)).any()


def test_cloth_that_moves_with_its_limb_stays_though_it_has_been_cut(body):
    part = cloth(SLEEVE)
    rest = part.with_vertices(lifted(part.vertices, np.ones(part.vertex_count)))
    found = find_shreds(part, rest, *body, every_border(part))
    # The disc of the opening does not reach into the four corners.
    assert part.face_areas[found].sum() < 4 * 0.014**2


def test_ribbons_and_small_pieces_beside_a_cut_are_shreds(body):
    """None of them is drawn out: a ribbon 2 cm wide, and a piece of 4 square cm."""
    ribbon, piece = (slice(10, 14), slice(12, 40)), (slice(30, 34), slice(45, 49))
    part = cloth((slice(0, 60), slice(0, 20)), ribbon, piece)
    found = find_shreds(part, part, body[0], body[0], every_border(part))
    column = (AXIS - part.face_centers[:, 0]) / CELL
    assert found[column > 22].all() and (column > 45).any()
    assert part.face_areas[found & (column < 20)].sum() < 6 * 0.014**2


def test_only_new_borders_are_cuts():
    part = cloth(SLEEVE)
    left = part.vertices[:, 0] > AXIS - 0.5 * CELL
    assert not (cut_borders(part, left) & left).any()
    assert cut_borders(part, left).sum() == len(np.unique(part.border_edges)) - left.sum()


def test_teeth_of_a_cut_are_smoothed_and_other_borders_stay():
    """A saw of one cell along the cut becomes straight; what the vertices carry moves with them; no face turns over."""
    teeth = tuple((slice(k, k + 1), slice(12, 13)) for k in range(0, 40, 2))
    part = cloth(SLEEVE, *teeth)
    inwards = (AXIS - part.vertices[:, 0]) / CELL
    cut = np.zeros(part.vertex_count, dtype=bool)
    cut[part.border_edges] = True
    middle = (part.vertices[:, 1] > 0.52) & (part.vertices[:, 1] < 0.68)
    cut &= (inwards > 11.5) & middle
    smooth, carried = smooth_cuts(part, cut, part.vertices[:, :1])
    np.testing.assert_allclose(carried[:, 0], smooth.vertices[:, 0], atol=1e-12)
    depth = (AXIS - smooth.vertices[cut & (np.abs(part.vertices[:, 1] - 0.6) < 0.06), 0]) / CELL
    assert np.ptp(depth) < 0.35
    still = inwards < 10.5
    np.testing.assert_array_equal(smooth.vertices[still], part.vertices[still])
    assert (np.einsum("ij,ij->i", smooth.face_cross, part.face_cross) > 0).all()
