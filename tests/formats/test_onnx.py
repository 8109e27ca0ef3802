"""The step as ONNX, run by onnxruntime, against the player."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from avatar.formats.onnx_step import write_onnx
from avatar.runtime import AvatarPlayer
from smplxpp.core.errors import MissingExtraError
from tests.runtime.bundles import EXACT, KINDS, dance, student, write

pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")


def run(path, player: AvatarPlayer, params, **more) -> dict[str, np.ndarray]:
    """What onnxruntime makes of a frame."""
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    E = player.bundle.sizes["E"]
    feed = {"pose": player._body.axis_angles(params)[0], "transl": params.transl[0], "eye": [0.3, 1.0, 4.0]}
    feed |= {"expression": np.zeros(E) if params.expression.shape[1] == 0 else params.expression[0, :E], **more}
    feed = {name: np.asarray(value, np.float32) for name, value in feed.items()}
    names = [output.name for output in session.get_outputs()]
    return dict(zip(names, session.run(None, feed), strict=True))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("config", [EXACT, None])
def test_onnxruntime_poses_as_the_player_does(tmp_path, kind, config):
    write(tmp_path / "me.avatar", student(kind), config)
    player = AvatarPlayer(tmp_path / "me.avatar", threads=1)
    write_onnx(tmp_path / "me.onnx", player.bundle)
    for k in (0, 4):
        params = dance().frame(k)
        if k:  # far from what training saw, where shapes fade
            params = replace(params, body_pose=params.body_pose + 0.3)
        ours, theirs = player.pose(params), run(tmp_path / "me.onnx", player, params)
        np.testing.assert_allclose(theirs["means"], ours.means, atol=2e-6)
        np.testing.assert_allclose(theirs["scales"], ours.scales, rtol=1e-4)
        np.testing.assert_allclose(theirs["opacities"], ours.opacities)
        same = np.abs(np.sum(theirs["quats"] * ours.quats, axis=1) / np.square(ours.quats).sum(axis=1))
        np.testing.assert_allclose(same, 1.0, atol=1e-5)
        colors = ours.colors(np.array([0.3, 1.0, 4.0], np.float32))
        np.testing.assert_allclose(theirs["colors"], colors, atol=2e-5)


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_colours_of_other_degrees(tmp_path, degree):
    write(tmp_path / "me.avatar", student("no field"), EXACT)
    bundle = AvatarPlayer(tmp_path / "me.avatar", threads=1).bundle
    count = (degree + 1) ** 2 - 1
    sh = np.random.default_rng(degree).normal(scale=0.2, size=(bundle.sizes["N"], count, 3)).astype(np.float32)
    bundle = replace(bundle, tensors={**bundle.tensors, "gaussians.sh": sh}, sizes={**bundle.sizes, "K": count})
    player = AvatarPlayer(bundle, threads=1)
    write_onnx(tmp_path / "me.onnx", bundle)
    ours = player.pose(dance().frame(2)).colors(np.array([0.3, 1.0, 4.0], np.float32))
    theirs = run(tmp_path / "me.onnx", player, dance().frame(2))["colors"]
    np.testing.assert_allclose(theirs, ours, atol=2e-5)


def test_a_code_of_the_training_is_taken(tmp_path):
    write(tmp_path / "me.avatar", student("control points"), EXACT)
    player = AvatarPlayer(tmp_path / "me.avatar", threads=1)
    write_onnx(tmp_path / "me.onnx", player.bundle)
    codes = player.bundle.tensors["field.codes"]
    frame = player.bundle.about.frames[1]
    ours = player.pose(dance().frame(1), frame=frame).means.copy()
    theirs = run(tmp_path / "me.onnx", player, dance().frame(1), code=codes[1])["means"]
    np.testing.assert_allclose(theirs, ours, atol=2e-6)
    assert np.abs(run(tmp_path / "me.onnx", player, dance().frame(1))["means"] - ours).max() > 1e-6


def test_it_says_what_it_is_and_repeats(tmp_path):
    import onnx

    write(tmp_path / "me.avatar", student("whole"), EXACT, licence="CC0-1.0")
    bundle = AvatarPlayer(tmp_path / "me.avatar", threads=1).bundle
    for name in ("a", "b"):
        write_onnx(tmp_path / f"{name}.onnx", bundle)
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()
    model = onnx.load(tmp_path / "a.onnx")
    said = {entry.key: entry.value for entry in model.metadata_props}
    assert said["licence"] == "CC0-1.0" and said["joint_names"].split()[0] == "pelvis"


def test_a_missing_onnx_is_named(tmp_path, monkeypatch):
    write(tmp_path / "me.avatar", student("no field"), EXACT)
    bundle = AvatarPlayer(tmp_path / "me.avatar", threads=1).bundle
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MissingExtraError, match=r"extra onnx"):
        write_onnx(tmp_path / "me.onnx", bundle)
    assert not (tmp_path / "me.onnx").exists()
