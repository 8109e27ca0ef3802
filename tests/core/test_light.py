"""Irradiance of panoramas against the integral that it stands for, and colours in another light."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.core import InputError, normalize_rows
from smplxpp.core.colors import linear_from_srgb, srgb_from_linear
from smplxpp.core.light import Irradiance, Relighting, harmonics, panorama_directions

NORMALS = normalize_rows(np.random.default_rng(0).normal(size=(40, 3)))
WHITE = Irradiance.uniform()


def solid(height: int, width: int) -> np.ndarray:
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    return np.repeat((edges[:-1] - edges[1:])[:, None] * 2.0 * np.pi / width, width, axis=1)


def evening(height: int = 64, width: int = 128) -> np.ndarray:
    """A broad red light from the side and a blue sky."""
    towards = panorama_directions(height, width)
    red = np.exp(3.0 * (towards @ [0.9, 0.3, 0.3] - 1.0))[..., None] * [4.0, 1.5, 0.5]
    return red + np.maximum(towards[..., 1:2], 0.0) * [0.2, 0.4, 1.0]


def test_harmonics_are_orthonormal():
    values = harmonics(panorama_directions(64, 128)).reshape(-1, 9)
    np.testing.assert_allclose(values.T @ (values * solid(64, 128).reshape(-1, 1)), np.eye(9), atol=2e-3)


def test_irradiance_is_the_integral_over_the_hemisphere():
    light, towards = evening(), panorama_directions(64, 128)
    cosine = np.maximum(np.einsum("hwx,nx->nhw", towards, NORMALS), 0.0)
    truth = np.einsum("nhw,hwc,hw->nc", cosine, light, solid(64, 128)) / np.pi
    # Ramamoorthi and Hanrahan: nine coefficients leave some percent, 3 % on average at most.
    found = Irradiance.of_environment(light).at(NORMALS)
    assert np.abs(found - truth).mean() < 0.03 * truth.mean() and np.abs(found - truth).max() < 0.09 * truth.max()


def test_even_light_is_even_and_its_scale_is_kept():
    even = Irradiance.of_environment(np.full((16, 32, 3), 2.5))
    np.testing.assert_allclose(even.at(NORMALS), 2.5, rtol=0.01)
    assert even.mean == pytest.approx(2.5) and WHITE.mean == pytest.approx(1.0)
    assert Irradiance.of_environment(7.0 * evening()).exposed().mean == pytest.approx(1.0)
    np.testing.assert_allclose(even.exposed(2.0).coefficients, 2.0 * even.coefficients)


def test_a_light_is_turned_about_the_vertical():
    towards, light = panorama_directions(32, 64), np.zeros((32, 64, 3))
    light[(towards @ [1.0, 0.0, 0.0]) > 0.9] = 1.0
    brightest = {
        turn: Irradiance.of_environment(light, turn=turn).at(np.eye(3)).sum(1).argmax() for turn in (0.0, -90.0)
    }
    assert brightest == {0.0: 0, -90.0: 2}  # from +X to +Z: a right-handed turn by -90 degrees
    above = np.zeros((32, 64, 3))
    above[0] = 1.0
    lit = Irradiance.of_environment(above).at(np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]))[:, 0]
    assert lit[0] > 3.0 * lit[1]


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf, 0.0])
def test_what_is_no_light_is_refused(bad):
    with pytest.raises(InputError, match="panorama"):
        Irradiance.of_environment(np.full((4, 8, 3), bad))


def test_colours_change_as_the_light_does():
    srgb = np.random.default_rng(1).uniform(0.05, 0.6, (40, 3))
    light = Irradiance.of_environment(evening()).exposed(0.4)
    there = Relighting(light, WHITE).colors(srgb, NORMALS)
    expected = linear_from_srgb(srgb) * light.at(NORMALS)
    np.testing.assert_allclose(linear_from_srgb(there), np.minimum(expected, 1.0), atol=2e-4)
    dim = there.max(axis=1) < 0.99
    back = Relighting(WHITE, light).colors(there, NORMALS)
    lit = light.at(NORMALS).min(axis=1) > 0.05
    np.testing.assert_allclose(back[dim & lit], srgb[dim & lit], atol=2e-4)
    np.testing.assert_allclose(Relighting(light, light).colors(srgb, NORMALS)[lit], srgb[lit], atol=1e-4)
    # Nothing is known of a place without a normal: it stays.
    np.testing.assert_allclose(Relighting(light, WHITE).colors(srgb, 0.0 * NORMALS), srgb, atol=1e-4)


def test_srgb_there_and_back():
    linear = np.linspace(0.0, 1.0, 200)
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(linear)), linear, atol=1e-6)
