"""Quaternions of matrices and back."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from avatar.gaussians.tensor_operations import matrix_from_quat, multiply_quats, quat_from_matrix
from smplxpp.core.rotations import matrix_from_rotvec


def rotations(count: int = 200) -> torch.Tensor:
    """Random rotations, the identity, half turns about each axis and turns just short of them."""
    rng = np.random.default_rng(0)
    special = [(0, 0, 0), *(np.pi * np.eye(3)), *((np.pi - 1e-9) * np.eye(3)), (1e-9, 0, 0), (2, 2, 0), (-3, 0.1, 0)]
    vectors = np.concatenate([rng.normal(size=(count, 3)) * 2, special])
    return torch.tensor(Rotation.from_rotvec(vectors).as_matrix())


def test_round_trip_and_agreement_with_scipy():
    matrices = rotations()
    quats = quat_from_matrix(matrices)
    torch.testing.assert_close(matrix_from_quat(quats), matrices, atol=1e-14, rtol=0)
    torch.testing.assert_close(quats.norm(dim=-1), torch.ones(len(quats), dtype=torch.float64))
    theirs = torch.tensor(Rotation.from_matrix(matrices.numpy()).as_quat()[:, [3, 0, 1, 2]])
    torch.testing.assert_close((quats * theirs).sum(-1).abs(), torch.ones(len(quats), dtype=torch.float64))


def test_the_length_of_a_quaternion_does_not_matter():
    quats = quat_from_matrix(rotations(10))
    torch.testing.assert_close(matrix_from_quat(-3.7 * quats), matrix_from_quat(quats))


def test_product_is_composition():
    first, second = rotations(), rotations().flip(0)
    product = multiply_quats(quat_from_matrix(first), quat_from_matrix(second))
    torch.testing.assert_close(matrix_from_quat(product), first @ second, atol=1e-13, rtol=0)


@pytest.mark.parametrize(
    "vector", [(0, 0, 0), (np.pi, 0, 0), (0, np.pi, 0), (0, 0, -np.pi), (2.2, 2.2, 0), (1, -2, 0.5)]
)
def test_gradients_at_half_turns_and_the_identity(vector):
    def outer(vector):
        quat = quat_from_matrix(matrix_from_rotvec(vector))
        return quat[:, None] * quat  # free of the sign, which jumps somewhere in every choice

    assert torch.autograd.gradcheck(outer, torch.tensor(vector, dtype=torch.float64, requires_grad=True))
    quat = quat_from_matrix(matrix_from_rotvec(torch.tensor(vector, dtype=torch.float64)))
    assert torch.autograd.gradcheck(matrix_from_quat, (1.7 * quat).requires_grad_(True))
