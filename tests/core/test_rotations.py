import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from smplxpp.core.rotations import array_namespace, matrix_from_rotvec, rotation_between, rotvec_from_matrix

axes = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 1e-3)
# Angles in and around the delicate places: 0, the switch of the series, pi.
angles = st.one_of(st.floats(0, np.pi), st.floats(0, 1e-6), st.floats(0.0099, 0.0101), st.floats(np.pi - 1e-7, np.pi))


@given(axes, angles)
def test_matrices_equal_scipy_and_come_back(axis, angle):
    rotvec = np.array(axis) / np.linalg.norm(axis) * angle
    matrix = matrix_from_rotvec(rotvec)
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(rotvec).as_matrix(), atol=2e-15, rtol=0)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=2e-15)  # three products of rounded numbers
    # At pi both signs are right: compare the rotations; away from it, the vectors.
    back = rotvec_from_matrix(matrix)
    np.testing.assert_allclose(matrix_from_rotvec(back), matrix, atol=2e-15)
    if angle < np.pi - 1e-6:
        np.testing.assert_allclose(back, rotvec, atol=1e-9)


def test_small_vectors_keep_their_digits():
    rotvec = np.array([[1e-12, -2e-12, 3e-12], [1e-200, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(rotvec_from_matrix(matrix_from_rotvec(rotvec)), rotvec, rtol=1e-12, atol=1e-30)


def test_leading_axes_are_kept():
    rotvec = np.random.default_rng(0).normal(size=(2, 4, 3))
    assert matrix_from_rotvec(rotvec).shape == (2, 4, 3, 3)
    assert rotvec_from_matrix(matrix_from_rotvec(rotvec)).shape == (2, 4, 3)
    assert not rotvec_from_matrix(np.broadcast_to(np.eye(3), (2, 3, 3))).any()
    assert matrix_from_rotvec(np.zeros((0, 3))).shape == (0, 3, 3)


def test_torch_gives_the_same_numbers_and_gradients_at_zero():
    torch = pytest.importorskip("torch")
    assert array_namespace(np.zeros(1)) is np
    assert array_namespace(torch.zeros(1)) is torch
    rotvec = np.random.default_rng(1).normal(size=(5, 3))
    rotvec[0] = 0
    tensor = torch.tensor(rotvec, requires_grad=True)
    np.testing.assert_allclose(matrix_from_rotvec(tensor).detach().numpy(), matrix_from_rotvec(rotvec), atol=1e-15)
    assert torch.autograd.gradcheck(matrix_from_rotvec, (tensor,))


@given(axes, angles)
def test_points_are_turned_onto_others_and_never_mirrored(axis, angle):
    points = np.random.default_rng(0).normal(size=(9, 3))
    turned = points @ Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle).as_matrix()
    np.testing.assert_allclose(points @ rotation_between(points, turned), turned, atol=1e-12)
    mirrored = rotation_between(points, turned * np.array([-1.0, 1.0, 1.0]))
    assert np.linalg.det(mirrored) > 0.999
