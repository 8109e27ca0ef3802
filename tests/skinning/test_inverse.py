"""Inverse skinning: the round trip, its bounds and its equivariances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from smplxpp.body import load_body
from smplxpp.body.named_poses import stress_poses
from smplxpp.core import BodyParams, GeometryWarning, InputError, SkinWeights
from smplxpp.skinning import UnposeConfig, invertible_weights, pose, unpose


def random_rig(seed: int, joints: int = 6, vertices: int = 40, max_angle: float = 1.2):
    rng = np.random.default_rng(seed)
    transforms = np.tile(np.eye(4), (joints, 1, 1))
    transforms[:, :3, :3] = Rotation.from_rotvec(rng.uniform(-1, 1, (joints, 3)) * max_angle / np.sqrt(3)).as_matrix()
    transforms[:, :3, 3] = rng.normal(0, 0.5, (joints, 3))
    weights = rng.dirichlet(np.full(joints, 0.3), vertices)
    return rng.normal(size=(vertices, 3)), weights / weights.sum(axis=1, keepdims=True), transforms


def hinge(degrees: float) -> np.ndarray:
    """Two joints, the second turned by `degrees` about z."""
    transforms = np.tile(np.eye(4), (2, 1, 1))
    transforms[1, :3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return transforms


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_round_trip_both_ways(seed):
    points, weights, transforms = random_rig(seed)
    offsets = np.random.default_rng(seed + 1).normal(0, 0.01, points.shape)
    unposed = unpose(points, weights, transforms, rest_offsets=offsets)
    assert np.abs(pose(unposed.vertices, weights, transforms, rest_offsets=offsets) - points).max() < 1e-9
    posed = pose(points, weights, transforms, rest_offsets=offsets)
    assert np.abs(unpose(posed, weights, transforms, rest_offsets=offsets).vertices - points).max() < 1e-9
    assert unposed.report.round_trip_max < 1e-9


def test_offsets_are_subtracted_after_the_inverse():
    points, weights, transforms = random_rig(3)
    offsets = np.random.default_rng(0).normal(0, 0.01, points.shape)
    without = unpose(points, weights, transforms).vertices
    assert np.allclose(
        unpose(points, weights, transforms, rest_offsets=offsets).vertices, without - offsets, atol=1e-14
    )


def test_one_owner_is_a_rigid_motion():
    points, _, transforms = random_rig(4)
    owner = np.arange(len(points)) % len(transforms)
    unposed = unpose(points, np.eye(len(transforms))[owner], transforms)
    inverse = np.linalg.inv(transforms)[owner]
    assert np.allclose(unposed.vertices, np.einsum("nij,nj->ni", inverse[:, :3, :3], points) + inverse[:, :3, 3])
    assert np.allclose(unposed.determinant, 1.0, atol=1e-12)


def test_sparse_and_dense_weights_agree():
    points, weights, transforms = random_rig(5)
    sparse = SkinWeights.from_dense(weights)
    assert np.allclose(
        unpose(points, sparse, transforms).vertices, unpose(points, sparse.dense(), transforms).vertices, atol=1e-15
    )


def test_a_rigid_motion_of_the_posed_world_changes_nothing_at_rest():
    points, weights, transforms = random_rig(6)
    world = np.eye(4)
    world[:3, :3] = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
    world[:3, 3] = [1.0, -2.0, 0.5]
    moved = points @ world[:3, :3].T + world[:3, 3]
    assert np.allclose(
        unpose(moved, weights, world @ transforms).vertices, unpose(points, weights, transforms).vertices, atol=1e-12
    )


def test_units_and_order_of_the_vertices():
    points, weights, transforms = random_rig(7)
    rest = unpose(points, weights, transforms).vertices
    scaled = transforms.copy()
    scaled[:, :3, 3] *= 1000.0
    assert np.allclose(unpose(points * 1000.0, weights, scaled).vertices, rest * 1000.0, rtol=1e-9, atol=1e-7)
    order = np.random.default_rng(0).permutation(len(points))
    assert np.allclose(unpose(points[order], weights[order], transforms).vertices, rest[order], atol=1e-13)


@pytest.mark.parametrize(("degrees", "determinant"), [(90, 0.5), (120, 0.25), (150, 0.0669873)])
def test_determinant_of_an_even_blend(degrees, determinant):
    config = UnposeConfig(warn_below=0.0)
    unposed = unpose(np.ones((1, 3)), np.full((1, 2), 0.5), hinge(degrees), config=config)
    assert unposed.determinant[0] == pytest.approx(determinant, abs=1e-7)


def test_bounds_warn_and_fail():
    weights = np.array([[1.0, 0.0], [0.5, 0.5]])
    with pytest.warns(GeometryWarning, match="1 of 2 vertices"):
        unposed = unpose(np.ones((2, 3)), weights, hinge(130))
    assert unposed.report.below_warning == 1
    with pytest.raises(InputError, match=r"1 vertices below: 1 \("):
        unpose(np.ones((2, 3)), weights, hinge(170))
    unpose(np.ones((2, 3)), weights, hinge(119))


def test_one_folded_vertex_is_mended_and_all_others_stay():
    """One vertex between limbs turned by 170 degrees stopped the build of a whole person."""
    weights = SkinWeights.from_dense(np.array([[1.0, 0.0], [0.5, 0.5], [0.5, 0.5], [0.8, 0.2]]))
    for degrees in (170, 180):
        found, changed = invertible_weights(weights, hinge(degrees))
        assert changed.tolist() == [False, True, True, False]
        assert np.array_equal(found.dense()[~changed], weights.dense()[~changed])
        # The smallest step that suffices: the one before it would not.
        assert (
            unpose(np.ones((4, 3)), found, hinge(degrees), config=UnposeConfig(warn_below=0.0)).determinant[1] >= 0.05
        )
        strongest = found.dense()[1].max() - 0.025
        assert blended_determinant([strongest, 1 - strongest], hinge(degrees)) < 0.05
    assert invertible_weights(weights, hinge(120))[0] is weights


def blended_determinant(weights, transforms) -> float:
    return float(np.linalg.det(np.tensordot(weights, transforms[:, :3, :3], axes=1)))


def test_the_body_itself_in_hard_poses():
    body = load_body()
    params = stress_poses(BodyParams.rest(betas=body.num_betas, expressions=body.num_expressions))
    posed = body.forward(params)
    for index in range(len(params)):
        frame = posed.frame(index)
        unposed = unpose(
            frame.vertices, body.weights, frame.posed_from_rest, config=UnposeConfig(warn_below=0.0, fail_below=1e-6)
        )
        assert np.abs(unposed.vertices - frame.rest_vertices).max() < 1e-9
        assert unposed.report.round_trip_max < 1e-9


@pytest.mark.parametrize(
    ("change", "subject"),
    [
        ({"points": np.zeros((3, 2))}, "posed vertices"),
        ({"points": np.zeros((0, 3))}, "posed vertices"),
        ({"points": np.full((40, 3), np.nan)}, "posed vertices"),
        ({"weights": np.ones((40, 6))}, "skinning weights"),
        ({"weights": np.zeros((40, 6))}, "skinning weights"),
        ({"weights": np.full((7, 6), 1 / 6)}, "skinning weights"),
        ({"transforms": np.tile(np.eye(4), (1, 6, 1, 1))}, "posed_from_rest"),
        ({"transforms": np.tile(np.eye(4), (5, 1, 1))}, "posed_from_rest"),
        ({"transforms": np.tile(np.eye(4) + np.eye(4, k=-3), (6, 1, 1))}, "posed_from_rest"),
        ({"offsets": np.zeros((39, 3))}, "rest offsets"),
    ],
)
def test_bad_input_is_named(change, subject):
    points, weights, transforms = random_rig(8)
    values = {"points": points, "weights": weights, "transforms": transforms, "offsets": None} | change
    with pytest.raises(InputError, match=subject):
        unpose(values["points"], values["weights"], values["transforms"], rest_offsets=values["offsets"])
