"""The player's pictures in another light: the normals that it draws, and what the light does to colours."""

from __future__ import annotations

import numpy as np
import pytest

from avatar.runtime import AvatarPlayer
from avatar.runtime.splatting import facing_normals
from smplxpp.core.colors import linear_from_srgb
from smplxpp.core.light import Irradiance, Relighting, panorama_directions
from tests.dolls.dancing import cameras, dance
from tests.runtime.bundles import EXACT, student, write

WHITE = Irradiance.uniform()


@pytest.fixture(scope="module")
def player(tmp_path_factory) -> AvatarPlayer:
    path = tmp_path_factory.mktemp("lit") / "me.avatar"
    write(path, student("whole"), EXACT)
    player = AvatarPlayer(path, threads=1)
    player.pose(dance().frame(2))
    return player


def test_normals_are_those_of_the_surface(player):
    t = player.bundle.tensors
    corners = player.vertices[t["surface.faces"][player._face_of]].astype(np.float64)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    np.testing.assert_allclose(np.linalg.norm(player.normals, axis=1), 1.0, atol=1e-5)
    cosine = np.einsum("nx,nx->n", player.normals, flat)
    assert np.median(cosine) > 0.97 and np.quantile(cosine, 0.02) > 0.7
    # They vary over a triangle: a corner's Gaussian has that corner's normal.
    assert len(np.unique(player.normals.round(6), axis=0)) > 0.95 * len(flat)


def test_the_far_side_turns_its_inner_side_to_the_eye(player):
    splats, normals = player._splats, player.normals
    eye = np.array([0.0, 0.5, 3.0])
    turned = facing_normals(normals, splats, eye)
    towards = (splats.means - eye) / np.linalg.norm(splats.means - eye, axis=1, keepdims=True)
    assert np.einsum("nx,nx->n", turned, towards).max() < 0.36
    before = np.einsum("nx,nx->n", normals, towards)
    np.testing.assert_array_equal(turned[before < 0.3], normals[before < 0.3])


def test_the_same_light_changes_nothing_and_half_the_light_halves(player):
    camera, white = cameras()["Ring0"], (1.0, 1.0, 1.0)
    image, alpha = player.draw(camera, background=white)
    same, _ = player.draw(camera, background=white, relighting=Relighting(WHITE, WHITE))
    np.testing.assert_allclose(same, np.clip(image, 0.0, 1.0), atol=2e-3)
    half, _ = player.draw(camera, background=white, relighting=Relighting(WHITE.exposed(0.5), WHITE))
    whole = alpha > 0.99
    assert whole.sum() > 100
    np.testing.assert_allclose(
        linear_from_srgb(half[whole]), 0.5 * linear_from_srgb(np.clip(image[whole], 0.0, 1.0)), atol=0.01
    )
    empty = alpha == 0.0
    assert empty.any() and (half[empty] == 1.0).all()


@pytest.mark.parametrize("name", ["Ring0", "Ring1", "Held0"])
def test_light_from_the_right_of_a_picture_lights_its_right(player, name):
    camera = cameras()[name]
    right = np.asarray(camera.cam_from_world)[0, :3]
    lamp = np.exp(4.0 * (panorama_directions(32, 64) @ right - 1.0))[..., None] * np.ones(3)
    relighting = Relighting(Irradiance.of_environment(lamp).exposed(), WHITE)
    (before, alpha), (after, _) = player.draw(camera), player.draw(camera, relighting=relighting)
    columns = np.broadcast_to(np.arange(camera.width), alpha.shape)
    middle = np.average(columns, weights=alpha)
    gains = []
    for side in (columns > middle + 3, columns < middle - 3):
        of_side = side & (alpha > 0.9)
        gains.append(float(after[of_side].mean() / np.clip(before[of_side], 0.0, 1.0).mean()))
    assert gains[0] > 1.05 and gains[1] < 0.9
