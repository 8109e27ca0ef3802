"""The runtime against the torch student: places, colours, pictures, clothes, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.rendering.api import rasterize
from avatar.runtime import AvatarPlayer
from smplxpp.cloth import ClothDriver, ClothShape
from smplxpp.core import BodyParams, InputError
from tests.cloth.persons import person
from tests.cloth.test_driver import QUICK, garment, swaying
from tests.dolls.dancing import cameras, dance
from tests.runtime.bundles import EXACT, KINDS, dressed, student, write, write_dressed

EYE = np.float32([0.3, 0.8, 2.0])


def ordered(it) -> torch.Tensor:
    return torch.argsort(it.gaussians.face_index, stable=True)


def posed(it, params: BodyParams, frame: int | None = None):
    with torch.no_grad():
        return it(it.rig.pose(params, frame=frame), torch.tensor(EYE)[None])


def compare(splats, truth, order, *, places: float, colors: float) -> None:
    world = truth.gaussians
    np.testing.assert_allclose(splats.means, world.means[order].numpy(), rtol=0, atol=places)
    np.testing.assert_allclose(splats.scales, world.scales[order].numpy(), rtol=1e-3, atol=places)
    np.testing.assert_allclose(splats.colors(EYE), truth.colors[0][order].numpy(), rtol=0, atol=colors)
    mine, theirs = splats.quats, torch.nn.functional.normalize(world.quats[order], dim=1).numpy()
    mine = mine / np.linalg.norm(mine, axis=1, keepdims=True)
    assert np.abs((mine * theirs).sum(1)).min() > 1.0 - max(1e-5, colors * 1e-2)


@pytest.mark.parametrize("kind", KINDS)
def test_an_exact_bundle_is_the_torch_student(kind, tmp_path):
    it = student(kind)
    write(tmp_path / "a.avatar", it, EXACT)
    player, order = AvatarPlayer(tmp_path / "a.avatar", threads=2), ordered(it)
    for frame, code in ((3, 2), (5, None), (1, 1 if kind == "whole" else None)):
        splats = player.pose(dance().frame(frame), frame=code)
        compare(splats, posed(it, dance().frame(frame), code), order, places=2e-6, colors=1e-5)


@pytest.mark.parametrize("kind", ["whole", "shapes", "pruned"])
def test_a_small_bundle_is_within_its_steps(kind, tmp_path):
    it = student(kind)
    small, exact = (write(tmp_path / f"{config}.avatar", it, config)["total"] for config in (None, EXACT))
    assert small < 0.75 * exact
    splats = AvatarPlayer(tmp_path / "None.avatar", threads=1).pose(dance().frame(3), frame=2)
    compare(splats, posed(it, dance().frame(3), 2), ordered(it), places=2e-3, colors=0.02)  # of random networks


def test_pictures_are_those_of_the_torch_student(tmp_path):
    it = student("whole")
    write(tmp_path / "a.avatar", it, EXACT)
    player, camera = AvatarPlayer(tmp_path / "a.avatar"), cameras()["Held0"]
    player.pose(dance().frame(4))
    image, alpha = player.draw(camera, background=(0.2, 0.4, 0.6))
    with torch.no_grad():
        truth = it(it.rig.pose(dance().frame(4)), torch.tensor(camera.position, dtype=torch.float32)[None])
        world = truth.gaussians
        expected, its_alpha, _ = rasterize(
            *(world.means, world.quats, world.scales, world.opacities, truth.colors),
            torch.tensor(camera.cam_from_world[None], dtype=torch.float32),
            torch.tensor(camera.K[None], dtype=torch.float32),
            *(camera.width, camera.height),
            background=torch.tensor([0.2, 0.4, 0.6]),
            eps2d=0.1,
        )
    assert 0.05 < alpha.mean() < 0.9
    assert np.square(image - expected[0].numpy()).mean() < 10**-6.0  # 60 dB
    np.testing.assert_allclose(alpha, its_alpha[0, ..., 0].numpy(), atol=1e-3)


def test_threads_change_nothing(tmp_path):
    write(tmp_path / "a.avatar", student("whole"))
    one, three = (AvatarPlayer(tmp_path / "a.avatar", threads=n) for n in (1, 3))
    for name in ("means", "quats", "scales", "dc"):
        a, b = (getattr(player.pose(dance().frame(2)), name) for player in (one, three))
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(one.draw(cameras()["Held0"])[0], three.draw(cameras()["Held0"])[0])


def test_a_pose_does_not_depend_on_those_before_it(tmp_path):
    write(tmp_path / "a.avatar", student("whole"))
    player = AvatarPlayer(tmp_path / "a.avatar", threads=1)
    first = player.pose(dance().frame(0)).means.copy()
    player.pose(dance().frame(4))
    np.testing.assert_array_equal(player.pose(dance().frame(0)).means, first)


def test_moving_the_person_moves_the_splats(tmp_path):
    write(tmp_path / "a.avatar", student("whole"))
    player = AvatarPlayer(tmp_path / "a.avatar", threads=1)
    still = player.pose(dance().frame(3)).means.copy()
    away = replace(dance().frame(3), transl=dance().frame(3).transl + [[1.0, 2.0, -3.0]])
    np.testing.assert_allclose(player.pose(away).means, still + np.float32([1.0, 2.0, -3.0]), atol=2e-6)


def test_poses_count_as_known_as_in_torch(tmp_path):
    it = student("whole")
    write(tmp_path / "a.avatar", it)
    player = AvatarPlayer(tmp_path / "a.avatar", threads=1)
    for scale in (0.0, 1.0, 1.7, 6.0):
        theta = (scale * dance().body_pose[5]).astype(np.float32)
        assert player.pose_similarity(theta) == pytest.approx(float(it.pose_gate(torch.tensor(theta))), abs=1e-4)
    assert (
        player.pose_similarity(np.float32(9.0 * np.ones(63))) < 0.01
        and player.pose_similarity(np.float32(9.0 * np.ones(63)), 1) == 1.0
    )


def test_the_motion_comes_along(tmp_path):
    write(tmp_path / "a.avatar", student("student"))
    motion = AvatarPlayer(tmp_path / "a.avatar").motion
    assert len(motion) == len(dance())
    np.testing.assert_allclose(motion.body_pose, dance().body_pose, atol=1e-6)


def test_loose_clothes_are_simulated_as_in_torch(tmp_path):
    write_dressed(tmp_path, EXACT)
    it, player = dressed(), AvatarPlayer(tmp_path / "me.avatar", threads=1, cloth=QUICK)
    driver = ClothDriver(person(), [garment()], QUICK)
    for k in range(6):
        frame = swaying(k / 20.0)
        shape = driver.step(frame, 0.05)
        splats = player.step(frame, 0.05)
    with torch.no_grad():
        truth = it(it.rig.with_cloth(it.rig.pose(frame), shape), torch.tensor(EYE)[None])
    assert player.notes == driver.notes
    off = np.abs(splats.means - truth.gaussians.means[ordered(it)].numpy())
    assert off.max() < 2e-3 and off.mean() < 5e-5  # float32 places of particles come apart a little
    bare = AvatarPlayer(tmp_path / "me.avatar", threads=1).pose(frame).means
    assert np.abs(bare - splats.means).max() > 0.01
    player.restart()
    assert np.isfinite(player.step(swaying(0.0), 0.05).means).all()


def test_clothes_without_field_or_simulation_follow_the_joints(tmp_path):
    write_dressed(tmp_path, EXACT)
    frame, player, it = swaying(0.7), AvatarPlayer(tmp_path / "me.avatar", threads=1), dressed()
    by_joints = player.pose(frame, cloth=player.skinned_clothes).means
    zero = ClothShape(garment().vertices, np.zeros((len(garment().vertices), 3), np.float32), garment().share())
    with torch.no_grad():
        truth = it(it.rig.with_cloth(it.rig.pose(frame), zero), torch.tensor(EYE)[None])
    np.testing.assert_allclose(by_joints, truth.gaussians.means[ordered(it)].numpy(), atol=2e-5)


def test_parameters_of_others_are_refused(tmp_path):
    write(tmp_path / "a.avatar", student("student"))
    player = AvatarPlayer(tmp_path / "a.avatar", threads=1)
    with pytest.raises(InputError, match="one frame"):
        player.pose(dance())
    with pytest.raises(InputError, match=r"expression.*at most 2"):
        player.pose(replace(dance().frame(0), expression=np.ones((1, 5))))
    longer = replace(dance().frame(0), expression=np.array([[0.1, 0.2, 0.0, 0.0]]))
    assert np.isfinite(player.pose(longer).means).all()
    with pytest.raises(InputError, match="pinhole"):
        player.draw(replace(cameras()["Held0"], orthographic=True))
