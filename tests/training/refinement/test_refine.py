"""Poses of a doll refined on its photographs: disturbed ones come back, right ones stay, held-out ones are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.data.sequence import AvatarSequence
from avatar.gaussians.sampling import SamplingConfig
from avatar.training.refinement import photometric
from avatar.training.refinement.align import Alignment
from avatar.training.refinement.config import Level, RefineConfig
from avatar.training.refinement.refine import Refinement, refine_held_out, refine_poses
from smplxpp.core import BodyParams, InputError
from tests.dolls.gesturing import NOVEL_POSES, disturbed, gestures, sequence, template, write_gestures
from tests.pretended_cuda import pretended_cuda

CONFIG = RefineConfig(
    sampling=SamplingConfig(count=2500, head_share=None, sh_degree=0, opacity=0.95),
    reference_levels=(Level(0, 2),),
    levels=(Level(1, 2), Level(0, 4)),
    pixels_per_error=500.0,
)
QUICK = replace(CONFIG, reference_levels=(Level(1, 1),), levels=(Level(1, 1),))


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_gestures(tmp_path_factory.mktemp("captures") / "gestures")


@pytest.fixture(scope="module")
def start() -> BodyParams:
    return disturbed(gestures())


@pytest.fixture(scope="module")
def frames(capture, start, tmp_path_factory):
    return sequence(capture, start, tmp_path_factory.mktemp("start"))


@pytest.fixture(scope="module")
def found(frames) -> Refinement:
    return refine_poses(frames, CONFIG)


def error(params: BodyParams, rows: tuple[int, ...]) -> float:
    """Mean distance of the bare skin from the truth, millimetres."""
    bare = ~template().cloth_mask
    apart = template().pose(params)[:, bare] - template().pose(gestures().select(list(rows)))[:, bare]
    return 1e3 * float(np.linalg.norm(apart, axis=-1).mean())


def test_disturbed_poses_come_back(found, start):
    # A pixel of these pictures is 13 mm.
    before = error(start.select(list(found.frames)), found.frames)
    assert before > 10.0 and error(found.params, found.frames) < 0.3 * before
    assert (found.after < found.before).all() and found.kept == ()


@pytest.mark.long
def test_frames_are_shared_among_threads_and_give_the_bits_of_one(frames):
    config = replace(QUICK, reference_levels=(), cameras=True)
    alone, threads, seen = refine_poses(frames, config), torch.get_num_threads(), []
    torch.set_num_threads(3)
    try:
        together = refine_poses(frames, config, progress=lambda step, share: seen.append(share))
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)
    assert seen == sorted(seen) and seen[-1] == 1.0
    np.testing.assert_array_equal(together.params.full_pose, alone.params.full_pose)
    np.testing.assert_array_equal(together.after, alone.after)
    assert torch.equal(together.gaussians.dc, alone.gaussians.dc)
    for name, pose in alone.cameras.items():
        np.testing.assert_array_equal(together.cameras[name], pose)


@pytest.mark.parametrize("cameras", [False, True])
@pytest.mark.long
def test_a_killed_refinement_goes_on_to_the_same_bits(frames, tmp_path, cameras):
    """In the first pass of the second level, after the passes of the first one."""
    config = replace(QUICK, levels=(Level(1, 1), Level(1, 1)), cameras=cameras)
    whole = refine_poses(frames, config)

    def killed(step: str, share: float) -> None:
        # The reference frame is looked at twice; five frames four times, and twice more at the end.
        if share >= (2 + 2.5 * 5) / (2 + 6 * 5):
            raise KeyboardInterrupt

    file = tmp_path / "state.npz"
    with pytest.raises(KeyboardInterrupt):
        refine_poses(frames, config, state=file, progress=killed)
    shares = []
    again = refine_poses(frames, config, state=file, progress=lambda step, share: shares.append(share))
    np.testing.assert_array_equal(again.params.body_pose, whole.params.body_pose)
    np.testing.assert_array_equal(again.params.transl, whole.params.transl)
    assert torch.equal(again.gaussians.dc, whole.gaussians.dc)
    assert torch.equal(again.gaussians.normal_offset, whole.gaussians.normal_offset)
    assert again.history == whole.history and shares[-1] == 1.0
    for name, pose in whole.cameras.items():
        np.testing.assert_array_equal(again.cameras[name], pose)


def test_what_changed_is_told(found, start):
    assert found.frames == (0, 1, 2, 3, 4) and found.turned.shape == (5, len(found.joints))
    apart = 1e3 * np.linalg.norm(found.params.transl - start.select(list(found.frames)).transl, axis=1)
    np.testing.assert_allclose(found.moved, apart, atol=1e-6)
    assert found.turned[:, found.joints.index("head")].max() > 0.2
    np.testing.assert_array_equal(found.params.betas, start.select(list(found.frames)).betas)


def test_frames_whose_photographs_like_the_start_better_keep_it(frames, found, start, monkeypatch):
    def astray(self, levels, on_frame, *, file, stop):
        self.state = replace(self.state, transl=self.state.transl + [0.1, 0.0, 0.0])

    monkeypatch.setattr(Alignment, "run", astray)
    kept = refine_held_out(frames, found.gaussians, CONFIG)
    assert kept.kept == NOVEL_POSES and not kept.turned.any() and not kept.moved.any()
    given = start.select(list(NOVEL_POSES))
    np.testing.assert_allclose(kept.params.transl, given.transl, atol=1e-12)
    np.testing.assert_allclose(kept.params.body_pose, given.body_pose, atol=1e-9)


@pytest.mark.long
def test_right_poses_stay(capture, tmp_path):
    exact = refine_poses(sequence(capture, gestures(), tmp_path), CONFIG)
    assert error(exact.params, exact.frames) < 2.0


@pytest.mark.long
def test_the_same_seed_gives_the_same_bits(frames):
    one, two = (refine_poses(frames, QUICK) for _ in range(2))
    for name, array in one.params.as_dict().items():
        np.testing.assert_array_equal(array, two.params.as_dict()[name])
    assert not np.array_equal(one.params.transl, refine_poses(frames, replace(QUICK, seed=1)).params.transl)


@pytest.mark.long
def test_a_sequence_on_cuda_has_its_pictures_drawn_there(frames, monkeypatch):
    """Poses, colours and cameras are those of the CPU up to rounding; what is kept lies on the CPU."""
    config, drawn = replace(QUICK, cameras=True), set()
    real, some = photometric.rasterize, frames.train_frames[:2]

    def recorded(means, *others, **options):
        drawn.add(means.device.type)
        return real(means, *others, **options)

    monkeypatch.setattr(photometric, "rasterize", recorded)
    with pretended_cuda():
        moved = AvatarSequence(frames.capture, template(), device="cuda")
        there = refine_poses(moved, config, frames=some)
        apart = refine_held_out(moved, there.gaussians, config)
    assert drawn == {"cuda"}
    assert there.gaussians.dc.device.type == apart.gaussians.dc.device.type == "cpu"
    here = refine_poses(frames, config, frames=some)
    assert drawn == {"cuda", "cpu"}
    np.testing.assert_allclose(there.params.body_pose, here.params.body_pose, atol=1e-4)
    np.testing.assert_allclose(there.after, here.after, rtol=1e-3)
    np.testing.assert_allclose(there.gaussians.dc, here.gaussians.dc, atol=1e-3)
    for name, pose in here.cameras.items():
        np.testing.assert_allclose(there.cameras[name], pose, atol=1e-5)


def test_held_out_cameras_are_never_read_and_held_out_frames_are_refused(frames, monkeypatch):
    from avatar.training.refinement import refine as module

    read: set[tuple[str, int]] = set()
    real = module.read_view

    def recorded(capture, camera, frame):
        read.add((camera, frame))
        return real(capture, camera, frame)

    monkeypatch.setattr(module, "read_view", recorded)
    refine_poses(frames, QUICK)
    splits = frames.capture.splits
    assert {camera for camera, _ in read} == set(splits.train_cameras)
    assert {frame for _, frame in read} == set(splits.train_frames)
    with pytest.raises(InputError, match="trained on"):
        refine_poses(frames, QUICK, frames=(0, NOVEL_POSES[0]))
    with pytest.raises(InputError, match="trained on"):
        refine_poses(frames, QUICK, reference=NOVEL_POSES[0])


def test_held_out_frames_are_refined_apart_on_training_cameras(frames, found, start):
    apart = refine_held_out(frames, found.gaussians, CONFIG)
    assert apart.frames == NOVEL_POSES and apart.gaussians is found.gaussians
    assert error(apart.params, NOVEL_POSES) < 0.6 * error(start.select(list(NOVEL_POSES)), NOVEL_POSES)
    with pytest.raises(InputError, match="held out"):
        refine_held_out(frames, found.gaussians, CONFIG, frames=(0,))


def test_steps_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="levels"):
        RefineConfig(levels=())
    with pytest.raises(InputError, match="levels"):
        RefineConfig(levels=(Level(0, 0),))
    with pytest.raises(InputError, match="robust"):
        RefineConfig(robust=0.0)
