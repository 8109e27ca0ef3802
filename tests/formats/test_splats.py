"""Splats of a pose: as the runtime has them, turned, filled up."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.formats import world_splats
from avatar.runtime import AvatarPlayer
from avatar.runtime.splatting import Splatter
from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.core.spherical_harmonics import rotate_sh, sh_basis
from smplxpp.figures import VIEWS, fit_cameras
from tests.formats.foreign import as_world
from tests.formats.test_ply import random_splats
from tests.runtime.bundles import EXACT, dance, student, write


@pytest.fixture(scope="module")
def player(tmp_path_factory) -> AvatarPlayer:
    path = tmp_path_factory.mktemp("bundle") / "me.avatar"
    write(path, student("whole"), EXACT)
    return AvatarPlayer(path, threads=1)


def test_a_pose_of_the_player_is_the_same_picture(player):
    posed = player.pose(dance().frame(2))
    splats = world_splats(posed)
    for camera in fit_cameras(
        posed.means.astype(float), directions=[VIEWS[name] for name in ("front", "side")], height=96
    ):
        ours, _ = player.draw(camera)
        theirs, _ = Splatter().draw(as_world(splats), camera)
        assert np.abs(ours - theirs).max() < 1e-4 and ours.max() > 0.2


def test_they_are_copies_of_what_the_next_pose_writes_anew(player):
    splats = world_splats(player.pose(dance().frame(0)))
    before = splats.means.copy()
    player.pose(dance().frame(3))
    np.testing.assert_array_equal(splats.means, before)
    lengths = np.linalg.norm(splats.normals, axis=1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_turn_as_the_trainers_do(degree):
    rng = np.random.default_rng(degree)
    sh = rng.normal(size=(6, (degree + 1) ** 2 - 1, 3))
    rotations, of = matrix_from_rotvec(rng.normal(size=(3, 3))), np.array([0, 2, 1, 1, 0, 2])
    theirs = rotate_sh(torch.tensor(sh), torch.tensor(rotations[of])).numpy()
    np.testing.assert_allclose(rotate_sh(sh, rotations, of), theirs, atol=1e-12)
    directions = rng.normal(size=(9, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = sh_basis(torch.tensor(directions), degree).numpy()
    np.testing.assert_allclose(sh_basis(directions, degree), basis, atol=1e-15)


def test_who_turns_with_the_splats_sees_no_difference():
    splats = random_splats(30, 3)
    for rotvec in ([0.3, -1.0, 0.4], [np.pi, 0, 0], [0, 3.1, 0], [0, 0, -2.9]):
        R = matrix_from_rotvec(np.array(rotvec))
        turned = splats.rotated(R)
        directions = np.random.default_rng(1).normal(size=(30, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)

        def seen(it, towards):
            return np.einsum("nk,nkc->nc", sh_basis(towards, 3), it.f_rest.astype(float))

        np.testing.assert_allclose(seen(turned, directions @ R.T), seen(splats, directions), atol=1e-5)
        axes = [
            matrix_from_rotvec(2 * np.arccos(np.clip(q[:, :1], -1, 1)) * _unit(q[:, 1:]))
            for q in (splats.unit_quats.astype(float), turned.unit_quats.astype(float))
        ]
        np.testing.assert_allclose(axes[1], R @ axes[0], atol=1e-3)
        np.testing.assert_allclose(turned.means, splats.means @ R.T, atol=1e-5)


def test_filling_up_adds_zeros_alone():
    splats = random_splats(5, 1)
    padded = splats.padded()
    assert padded.degree == 3 and padded.f_rest.shape == (5, 15, 3)
    np.testing.assert_array_equal(padded.f_rest[:, :3], splats.f_rest)
    assert not padded.f_rest[:, 3:].any()


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
