from __future__ import annotations

import pytest

from avatar.losses.image_similarity import psnr_from_mse


def test_values_by_hand():
    assert psnr_from_mse(0.01) == pytest.approx(20.0)
    assert psnr_from_mse(1.0) == 0.0
    assert psnr_from_mse(0.25) == pytest.approx(6.0206, abs=1e-4)


def test_equal_images_have_a_finite_ratio():
    assert psnr_from_mse(0.0) == pytest.approx(120.0)
