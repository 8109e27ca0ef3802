"""What clothes stand off is shared, and says little of the body; what their sides say against each other says much."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core.mesh import TriangleMesh
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.locate import LocateConfig
from smplxpp.register.locate.cloth_offsets import NO_CELL, ClothOffsets
from smplxpp.register.locate.dressed import OuterBody
from smplxpp.register.locate.proxy import Region, regions
from smplxpp.register.locate.search import Search

CLOTHED = (Region.TRUNK, Region.ARM, Region.LEG)


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def offsets(body):
    return ClothOffsets.of(body)


@pytest.fixture()
def points(offsets):
    """Cells, rows, residuals and weights of 300 points."""
    rng = np.random.default_rng(3)
    cell = rng.integers(0, len(offsets.precision), 300)
    return cell, rng.normal(size=(300, 7)), 0.02 * rng.normal(size=300), rng.uniform(10.0, 1e4, 300)


def test_offsets_are_eliminated_as_correlated_noise_is(offsets, points):
    """The squares that are left are those of residuals whose noise has the offsets' covariance beside its own."""
    cell, rows, residual, weight = points
    left, least = offsets.eliminated(cell, weight, rows, residual)
    together = np.linalg.inv(offsets.precision)[cell][:, cell] + np.diag(1.0 / weight)
    assert np.allclose(left.T @ left, rows.T @ np.linalg.solve(together, rows))
    assert np.allclose(left.T @ least, rows.T @ np.linalg.solve(together, residual))


def test_the_order_of_points_says_nothing(offsets, points):
    cell, rows, residual, weight = points
    order = np.random.default_rng(0).permutation(len(cell))
    left, least = offsets.eliminated(cell, weight, rows, residual)
    other, of_other = offsets.eliminated(cell[order], weight[order], rows[order], residual[order])
    assert np.allclose(left.T @ least, other.T @ of_other)


def test_an_offset_is_found_and_what_is_far_from_it_left_out(offsets):
    cell = np.full(100, 5)
    residual = np.full(100, 0.03)
    residual[:20] = 0.3
    found = offsets.offsets(cell, residual, np.full(100, 1e4), np.full(100, 0.02))
    assert np.allclose(found, 0.03, atol=0.002)


def test_without_points_there_is_no_offset(offsets):
    none = np.zeros(0)
    assert len(offsets.offsets(none.astype(np.int64), none, none, none)) == 0
    _, least = offsets.eliminated(none.astype(np.int64), none, np.zeros((0, 4)), none)
    assert np.allclose(least, 0.0)


def test_cells_cover_what_clothes_cover_and_mirror_from_side_to_side(body, offsets):
    assert np.array_equal(offsets.cell != NO_CELL, np.isin(regions(body), CLOTHED))
    limb = np.argmax(body.weights, axis=1)
    for name in ("hip", "knee", "shoulder", "elbow"):
        left, right = (
            np.bincount(np.unique(offsets.cell[limb == body.joint_names.index(f"{s}_{name}")], return_inverse=True)[1])
            for s in ("left", "right")
        )
        assert np.allclose(left, right, rtol=0.2)


@pytest.mark.long
def test_a_wide_shirt_and_wide_trousers_leave_the_body_where_it_is(body):
    """Hands, face, neck and feet are as they are: joints stay within millimetres under clothes 4 cm off."""
    kinematics = Kinematics(body)
    state = BodyState(
        np.tile(np.eye(3), (1, body.joint_count, 1, 1)),
        np.zeros((1, 3)),
        np.zeros(body.num_betas),
        np.zeros((1, body.num_expressions)),
    )
    posture = kinematics.posture(state, 0)
    naked = OuterBody(kinematics).mesh(posture)
    clothed = np.isin(regions(body), CLOTHED)
    dressed = TriangleMesh(naked.vertices + 0.04 * clothed[:, None] * naked.vertex_normals, naked.faces)
    config = LocateConfig(fine_points=2000, coarse_points=200, finish_steps=8)
    search = Search(kinematics, dressed, config, None, lambda what, share: None)
    found = search.finished(search.measured("T", state))
    moved = np.linalg.norm(kinematics.posture(found.state, 0).joints - posture.joints, axis=1)[:22]
    assert moved.mean() < 0.008
