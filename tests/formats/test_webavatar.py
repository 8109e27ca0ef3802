"""WebAvatar's npz, played as its Unity package plays it: joints, four weights, quaternions blended, no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar.formats.webavatar import typical_pose, write_webavatar
from avatar.runtime import AvatarPlayer
from smplxpp.core.errors import InputError
from tests.formats.foreign import webavatar_played, webavatar_splats
from tests.runtime.bundles import EXACT, dance, student, write

# Its reader's table of arrays: kind and shape, N Gaussians, C control points, P with bases.
ARRAYS = {
    "_xyz": ("f", "N 3"),
    "_scaling": ("f", "N 3"),
    "_rotation": ("f", "N 4"),
    "_sh0": ("f", "N 1 3"),
    "opacity": ("u1", "N"),
    "t_joints": ("f", "55 3"),
    "weights_idx": ("u1", "N 4"),
    "weights_val": ("u1", "N 4"),
    "num_xyz_ft_head": ("u4", "1"),
    "gs_feat_knn": ("u2", "N"),
    "rot_idxs": ("u4", "P"),
    "scale_idxs": ("u4", "P"),
    "color_idxs": ("u4", "P"),
    "color_basis": ("f", "P 3 16"),
    "scaling_basis": ("f", "P 3 16"),
    "rotation_basis": ("f", "P 4 16"),
    "ctrl_pt_offsets": ("f", "C 3"),
    "ctrl_pt_basis": ("f", "C 3 16"),
    "gs_ctrl_knn": ("u2", "N 3"),
    "gs_ctrl_knn_weights": ("f", "N 3"),
    "ctrl_feat_knn": ("u2", "C"),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> tuple[AvatarPlayer, dict[str, np.ndarray]]:
    """A student of skinning alone, and its file."""
    folder = tmp_path_factory.mktemp("webavatar")
    write(folder / "me.avatar", student("no field"), EXACT)
    player = AvatarPlayer(folder / "me.avatar", threads=1)
    write_webavatar(folder / "me.npz", player)
    with np.load(folder / "me.npz") as stored:
        return player, dict(stored)


def test_the_file_has_what_its_reader_asks_for(written):
    player, arrays = written
    layers = {name: array for name, array in arrays.items() if name.startswith("layers.")}
    sizes = {"N": player.bundle.sizes["N"], "P": 1, "C": 1}
    assert set(arrays) - set(layers) == set(ARRAYS)
    for name, (kind, shape) in ARRAYS.items():
        wanted = tuple(sizes[one] if one in sizes else int(one) for one in shape.split())
        assert arrays[name].shape == wanted, name
        assert arrays[name].dtype.kind == "f" if kind == "f" else arrays[name].dtype == kind, name
    assert len(layers) == 8 and not any(array.any() for array in layers.values())
    inputs = 80  # 64 of the pose, 16 of the expression
    for k in range(4):
        outputs, parts, width = layers[f"layers.{2 * k}.weight"].shape
        assert (parts, width) == (1, inputs) and layers[f"layers.{2 * k}.bias"].shape == (outputs, 1)
        inputs = outputs
    assert inputs == 32
    assert (arrays["weights_val"].sum(axis=1, dtype=int) == 255).all() and arrays["weights_idx"].max() < 55


def test_in_a_pose_of_the_training_it_is_the_student_and_in_motion_near_it(written):
    player, arrays = written
    rest = player.pose(typical_pose(player))
    angles = player._body.axis_angles(typical_pose(player))[0]
    places, quats = webavatar_played(arrays, angles, np.zeros(3))
    np.testing.assert_allclose(places, rest.means, atol=1e-3)  # halves
    same = np.abs(np.sum(quats * rest.quats, axis=1)) / np.linalg.norm(rest.quats, axis=1)
    np.testing.assert_allclose(same, 1.0, atol=1e-3)
    np.testing.assert_allclose(arrays["_sh0"][:, 0] + 0.5, rest.dc, atol=1e-3)
    for k in (1, 3):
        params = replace(dance().frame(k), expression=np.zeros((1, 0)))
        places, _ = webavatar_played(arrays, player._body.axis_angles(params)[0], params.transl[0])
        away = np.linalg.norm(places - player.pose(params).means, axis=1)
        assert np.median(away) < 2e-3 and away.max() < 0.02


def test_field_and_shapes_of_a_typical_pose_are_in_it(tmp_path):
    write(tmp_path / "me.avatar", student("whole"), EXACT)
    player = AvatarPlayer(tmp_path / "me.avatar", threads=1)
    write_webavatar(tmp_path / "me.npz", player)
    params = typical_pose(player)
    assert np.abs(params.body_pose).max() > 0
    theirs = webavatar_splats(tmp_path / "me.npz", player._body.axis_angles(params)[0], np.zeros(3))
    np.testing.assert_allclose(theirs.means, player.pose(params).means, atol=1e-3)


def test_a_skeleton_of_another_family_is_refused(tmp_path, written):
    player, _ = written
    player = AvatarPlayer(replace(player.bundle, sizes={**player.bundle.sizes}), threads=1)
    player.bundle.sizes["J"] = 24
    with pytest.raises(InputError, match="55 joints"):
        write_webavatar(tmp_path / "a.npz", player)
    assert list(tmp_path.iterdir()) == []
