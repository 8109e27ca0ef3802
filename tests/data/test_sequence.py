"""Frames and views of a capture as training sees them: order, poses, crops."""

from __future__ import annotations

import shutil
from collections import Counter
from itertools import pairwise
from threading import current_thread

import numpy as np
import pytest
import torch

from avatar.data.sequence import Item, SequenceConfig, camera_centers_of
from avatar.rig.rig import Rig
from smplxpp.capture import open_capture
from smplxpp.core.errors import InputError
from tests.dolls.dancing import HEIGHT, HELD_OUT, NOVEL_POSES, TRAIN, WIDTH, dance, sequence, template, write_dance
from tests.pretended_cuda import pretended_cuda

TRAIN_FRAMES = (0, 1, 2, 3)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_dance(tmp_path_factory.mktemp("captures") / "dance")


@pytest.fixture(scope="module")
def made(root):
    return sequence(root)


def taken(made, steps: int, **how) -> list[Item]:
    return [item for step in range(steps) for item in made.items(step, **how)]


def test_what_is_trained_on_is_the_captures_split(made):
    assert made.train_cameras == TRAIN and made.train_frames == TRAIN_FRAMES
    assert made.background.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(("count", "views"), [(1, 1), (1, 3), (2, 2), (3, 1), (5, 4)])
def test_every_view_comes_once_a_cycle(made, count, views):
    cycle = len(TRAIN_FRAMES) * len(TRAIN)  # every frame through all its cameras, `views` at a time
    steps = cycle * 4 // count
    items = taken(made, steps, count=count, views=views, seed=3)
    epochs = [items[k : k + 4] for k in range(0, len(items) - 3, 4)]
    assert all({item.frame for item in epoch} == set(TRAIN_FRAMES) for epoch in epochs)
    whole = items[: 4 * len(TRAIN)]  # so many epochs show every view `views` times
    counts = Counter((item.frame, camera) for item in whole for camera in item.cameras)
    assert set(counts.values()) == {views} and len(counts) == cycle
    assert all(len(item.cameras) == views for item in items)


def test_the_order_follows_from_seed_and_step_alone(root, made):
    other = sequence(root)
    for step in (7, 0, 3):  # in any order
        assert made.items(step, count=2, views=2, seed=5) == other.items(step, count=2, views=2, seed=5)
    one, two = (taken(made, 12, count=1, views=1, seed=seed) for seed in (0, 1))
    assert one != two
    epochs = [[item.frame for item in one[k : k + 4]] for k in range(0, 12, 4)]
    assert any(a != b for a, b in pairwise(epochs))


def test_more_views_than_cameras_are_all_cameras(made):
    item = made.items(0, count=1, views=9, seed=0)[0]
    assert sorted(item.cameras) == sorted(TRAIN)


def test_a_frame_that_a_camera_lacks_is_seen_by_the_others(root, tmp_path):
    copy = shutil.copytree(root, tmp_path / "capture")
    (copy / "rgbs" / "Ring1" / "Ring1_rgb000002.png").unlink()
    for camera in TRAIN:
        (copy / "rgbs" / camera / f"{camera}_rgb000003.png").unlink()
    made = sequence(copy)
    assert made.train_frames == (0, 1, 2)
    seen = {(item.frame, camera) for item in taken(made, 30, count=1, views=2, seed=0) for camera in item.cameras}
    assert (2, "Ring1") not in seen and len(seen) == 3 * len(TRAIN) - 1


def test_motions_have_the_code_of_training_frames_alone(made):
    assert [made.pose(frame).frame for frame in range(6)] == [0, 1, 2, 3, None, None]
    posed = made.rig.skin(made.pose(NOVEL_POSES[0]))
    np.testing.assert_allclose(posed.numpy(), template().pose(dance().frame(NOVEL_POSES[0]))[0], atol=1e-6)
    assert made.pose(2) is made.pose(2)


def test_few_motions_are_kept(root):
    made = sequence(root, kept_poses=2)
    first = made.pose(0)
    made.pose(1)
    assert made.pose(0) is first
    made.pose(2)  # drops 1, which was used longest ago
    assert made.pose(0) is first and len(made._poses) == 2


def test_training_views_are_cut_to_the_person_and_whole_ones_are_not(root):
    made, margin = sequence(root, margin=3), 3
    part, whole = made.view("Ring0", 1), made.whole_view("Ring0", 1)
    assert (whole.camera.width, whole.camera.height) == (WIDTH, HEIGHT)
    assert part.alpha.numel() < whole.alpha.numel() and part.alpha.sum() == whole.alpha.sum()
    rows = torch.nonzero(whole.alpha.any(1))
    top = max(int(rows.min()) - margin, 0)
    assert part.K[1, 2] == pytest.approx(float(whole.K[1, 2]) - top)


def test_views_read_ahead_are_the_same(root, made):
    other = sequence(root)
    items = other.items(0, count=4, views=2, seed=0)
    other.expect(items)
    other.expect(items)  # twice does no harm
    for item in items:
        for camera in item.cameras:
            a, b = other.view(camera, item.frame), made.view(camera, item.frame)
            assert torch.equal(a.foreground, b.foreground) and torch.equal(a.K, b.K)


def test_beside_a_gpu_other_threads_make_poses_and_views_ahead(root, made, monkeypatch):
    """A pose took ten milliseconds of the thread that steps, in each step of a capture of thousands of frames."""
    threads, pose = [], Rig.pose

    def noted(*arguments, **named):
        threads.append(current_thread().name.split("_")[0])
        return pose(*arguments, **named)

    monkeypatch.setattr(Rig, "pose", noted)
    with pretended_cuda():
        told: list[str] = []  # the GPU of each thread: memory would be pinned for the first of a machine
        monkeypatch.setattr(torch.cuda, "set_device", lambda device: told.append(current_thread().name.split("_")[0]))
        other = sequence(root, device="cuda:0", readers=3)
        items = other.items(0, count=3, views=2, seed=0)
        other.expect(items)
        for item in items:
            found, truth = other.pose(item.frame), made.pose(item.frame)
            assert found.rest.is_cuda and found.frame == item.frame
            assert torch.equal(found.world_from_rest.cpu(), truth.world_from_rest)
            for camera in item.cameras:
                assert torch.equal(other.view(camera, item.frame).alpha.cpu(), made.view(camera, item.frame).alpha)
    assert threads[: len(items)].count("poses") == len(items)
    assert set(told) == {"poses", "views"}


@pytest.mark.parametrize("margin", [0, 5, 12])
def test_half_the_pixels_keep_points_where_they_are(root, margin):
    """A point projects to half the pixel coordinates, whatever the crop and an odd size did to the image."""
    view = sequence(root, margin=margin).view("Ring2", 3)
    half = view.halved()
    assert (half.camera.width, half.camera.height) == (view.camera.width // 2, view.camera.height // 2)
    assert half.alpha.shape == (half.camera.height, half.camera.width)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3)) + [0, 0.5, 0]
    fine, coarse = (v.camera.screen_from_world(points)[:, :2] for v in (view, half))
    np.testing.assert_allclose(coarse, 0.5 * fine, atol=1e-9)
    torch.testing.assert_close(half.position, view.position)


def test_eyes_are_the_cameras_places(made):
    views = [made.view(name, 0) for name in TRAIN]
    expected = np.stack([made.capture.cameras[name].position for name in TRAIN])
    np.testing.assert_allclose(camera_centers_of(views).numpy(), expected, atol=1e-6)


def test_what_is_missing_is_said(root, tmp_path):
    copy = shutil.copytree(root, tmp_path / "capture")
    (copy / "params" / "000002.npz").unlink()
    with pytest.raises(InputError, match="parameters of frame 2"):
        sequence(copy).pose(2)
    for camera in TRAIN:
        shutil.rmtree(copy / "rgbs" / camera)
    with pytest.raises(InputError, match="training cameras with images"):
        sequence(copy)
    capture = open_capture(root)
    assert set(HELD_OUT) <= set(capture.cameras)
    for change in ({"margin": -1}, {"kept_poses": 0}):
        with pytest.raises(InputError, match=next(iter(change))):
            SequenceConfig(**change)
