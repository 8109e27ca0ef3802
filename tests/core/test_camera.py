"""Camera: a crop or another resolution shows the same points at the pixels where they then are."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.core import Camera, InputError

CAMERA = Camera(np.array([[210.3, 0.4, 81.7], [0, 205.1, 62.2], [0, 0, 1.0]]), np.eye(4), 160, 121, name="c")
POINTS = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 4), (50, 3))


def pixels(camera: Camera) -> np.ndarray:
    return camera.screen_from_world(POINTS)[:, :2]


def test_a_crop_moves_the_points_by_its_corner():
    part = CAMERA.cropped((30, 11, 90, 71))
    assert (part.width, part.height, part.name) == (60, 60, "c")
    np.testing.assert_allclose(pixels(part), pixels(CAMERA) - (30, 11), atol=1e-9)
    moved = CAMERA.K.copy()
    moved[:2, 2] -= (30, 11)
    np.testing.assert_array_equal(part.K, moved)


def test_another_resolution_stretches_the_whole_image():
    small = CAMERA.resized(80, 60)
    assert (small.width, small.height) == (80, 60)
    np.testing.assert_allclose(pixels(small), pixels(CAMERA) * (80 / 160, 60 / 121), atol=1e-9)


def test_halving_without_the_last_odd_row_is_exact():
    half = CAMERA.cropped((0, 0, 160, 120), size=(80, 60))
    expected = CAMERA.K.copy()
    expected[:2] *= 0.5
    np.testing.assert_array_equal(half.K, expected)


def test_a_resampled_crop_is_the_crop_of_the_resampled_image():
    once = CAMERA.cropped((40, 33, 120, 99), size=(40, 33))
    twice = CAMERA.cropped((40, 33, 120, 99)).resized(40, 33)
    np.testing.assert_allclose(once.K, twice.K, atol=1e-12)


@pytest.mark.parametrize(("box", "size"), [((5, 5, 5, 9), None), ((9, 0, 5, 9), (3, 3)), ((0.5, 0, 5.5, 5), None)])
def test_empty_boxes_and_parts_of_pixels_are_refused(box, size):
    with pytest.raises(InputError, match="crop box"):
        CAMERA.cropped(box, size=size)
