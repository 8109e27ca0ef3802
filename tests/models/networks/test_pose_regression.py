"""The regression of new poses: its formula, its limits, and values that carry gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.models.networks.pose_dependence import PoseRegression


@pytest.fixture
def regression() -> PoseRegression:
    rng = torch.Generator().manual_seed(0)
    given = {name: torch.randn(size, generator=rng) for name, size in PoseRegression.shapes(5, 2).items()}
    return PoseRegression(**(given | {"low": -torch.ones(63), "high": 0.5 * torch.ones(63)}))


def test_it_is_linear_in_the_pose_within_the_limits(regression):
    theta = np.random.default_rng(1).uniform(-0.9, 0.4, (3, 63))
    found = regression(torch.tensor(theta, dtype=torch.float32)).numpy()
    tensors = {name: value.double().numpy() for name, value in regression.named_buffers()}
    z = (theta - tensors["center"]) @ tensors["rows"].T
    np.testing.assert_allclose(found, tensors["level"] + np.einsum("kxr,br->bkx", tensors["basis"], z), atol=1e-5)


def test_angles_beyond_the_limits_are_held_there(regression):
    theta = torch.zeros(2, 63)
    theta[:, 4], theta[:, 9] = torch.tensor([0.5, 3.0]), torch.tensor([-1.0, -2.0])
    at, beyond = regression(theta)
    torch.testing.assert_close(at, beyond)
    theta[1, 4] = 0.4
    assert not torch.allclose(*regression(theta))
