"""Joint correction on the doll whose dress swings: nearer to the truth, resumed to the bit, taken by a teacher."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from avatar.data.sequence import AvatarSequence
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.learned_gaussians import LEARNED
from avatar.models.tracked_surface import ControlCage, Track
from avatar.training.engine.processes import join_processes
from avatar.training.engine.session import JOINT, Session
from avatar.training.fit_teacher import FitTeacherConfig, fit_teacher
from avatar.training.tracking.config import JointConfig
from avatar.training.tracking.joint import correct_jointly
from smplxpp.core.errors import InputError
from tests.dolls.dancing import sequence, template, write_dance
from tests.dolls.tiny import TINY_TEACHER
from tests.training.tracking.test_track import CONFIG as TRACKING
from tests.training.tracking.test_track import error, painted

ROOT = Path(__file__).resolve().parents[3]
CONFIG = JointConfig(control_points=60, iterations=240, frame_iterations=10, views=1, smoothness=10.0)
SHORT = replace(CONFIG, iterations=8, frame_iterations=2)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return sequence(write_dance(tmp_path_factory.mktemp("captures") / "dance"))


def off_by(frames, metres: float) -> Track:
    """The true surface of each frame, the dress too far to one side or the other."""
    cage = ControlCage(frames.rig, 24)
    controls = torch.zeros(len(frames.train_frames), cage.count, 3)
    for row, frame in enumerate(frames.train_frames):
        swing = 0.03 * np.sin(1.5 * frame)
        # Along the world's x axis, as the doll's swing is, turned back by the dress's own rotation.
        rotation = frames.pose(frame).world_from_rest[cage.vertices, :3, :3]
        moved = torch.tensor([swing + metres * (-1.0) ** row, 0.0, 0.0], dtype=torch.float32)
        controls[row] = torch.where(cage.off_clothes[:, None], torch.zeros(3), rotation.transpose(-1, -2) @ moved)
    return Track({frame: row for row, frame in enumerate(frames.train_frames)}, controls, cage)


def test_a_dress_that_was_missed_is_found_and_the_body_stays(frames, tmp_path):
    before = off_by(frames, 0.008)
    bound, after, progress = correct_jointly(frames, painted(), before, CONFIG, Session(tmp_path))
    assert progress.finished and progress.iteration == 240
    errors = [[error(frames, f, one.displacements(f)) for f in frames.train_frames] for one in (before, after)]
    assert np.mean(errors[1]) < 0.8 * np.mean(errors[0])
    body = torch.tensor(template().vertex_part == 0)
    for frame in frames.train_frames:
        assert torch.equal(after.displacements(frame)[body], torch.zeros(int(body.sum()), 3))
    # The Gaussians have learned with them, and stay where they are bound.
    assert not torch.equal(bound.tensors["dc"], painted().tensors["dc"])
    assert torch.equal(bound.face_index, painted().face_index)


def test_clothes_near_the_skin_are_corrected_in_proportion_to_their_distance(frames, tmp_path):
    before, moved = off_by(frames, 0.008), {}
    for reach in (0.0, 0.04, 10.0):
        config = replace(SHORT, tight_reach=reach)
        _, after, _ = correct_jointly(frames, painted(), before, config, Session(tmp_path / str(reach)))
        moved[reach] = (after.controls - before.on(after.cage).controls).norm(dim=-1).amax(dim=0)
    cage = after.cage
    loose, tight = ~cage.off_clothes & (cage.from_body > 0.04), ~cage.off_clothes & (cage.from_body < 0.01)
    assert loose.any() and tight.any()
    # Adam moves what it may move by the rate a step; a correction is that, times the share of it that counts.
    assert float(moved[0.04][tight].max()) < 0.4 * float(moved[0.0][tight].max())
    assert float(moved[0.04][loose].median()) > 0.9 * float(moved[0.0][loose].median())
    assert float(moved[10.0].max()) < 0.05 * float(moved[0.0].max())


def test_a_stopped_correction_goes_on_to_the_same_bits(frames, tmp_path):
    track, results = off_by(frames, 0.005), []
    for name, limits in (("whole", (np.inf,)), ("stopped", (0.0, np.inf, np.inf))):
        for seconds in limits:
            session = Session(tmp_path / name, max_seconds=seconds)
            bound, found, progress = correct_jointly(frames, painted(), track, SHORT, session)
        assert progress.finished
        results.append((found.controls, bound.tensors))
    assert torch.equal(results[0][0], results[1][0])
    assert all(torch.equal(value, results[1][1][name]) for name, value in results[0][1].items())


def test_a_teacher_starts_from_what_was_corrected(frames, tmp_path):
    config = FitTeacherConfig(iterations=1, pretrain=None, track=TRACKING, joint=SHORT)
    teacher, progress = fit_teacher(frames, painted(), TINY_TEACHER, config, Session(tmp_path / "joint"))
    assert progress.finished and (tmp_path / "joint" / JOINT / "metrics.jsonl").is_file()
    assert teacher.track is not None and teacher.track.cage.count == SHORT.control_points
    alone, _ = fit_teacher(frames, painted(), TINY_TEACHER, replace(config, joint=None), Session(tmp_path / "alone"))
    assert alone.track is not None and alone.track.cage.count == TRACKING.control_points
    differ = [not torch.equal(getattr(teacher.gaussians, name), getattr(alone.gaussians, name)) for name in LEARNED]
    assert any(differ)


@pytest.mark.slow
def test_two_processes_share_the_frames_of_a_step(frames, tmp_path):
    """Two real ones, started by torchrun, against one that takes both frames; their gradients are added in float32."""
    shared = replace(SHORT, poses=2)
    _, alone, _ = correct_jointly(frames, painted(), off_by(frames, 0.005), shared, Session(tmp_path / "alone"))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, __file__, str(tmp_path)], env=environment, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr[-3000:]
    first, second = (np.load(tmp_path / f"controls_{rank}.npy") for rank in (0, 1))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_allclose(first, alone.controls.numpy(), atol=1e-4)


def test_without_clothes_nothing_is_corrected(frames, tmp_path):
    naked = AvatarSequence(frames.capture, template().naked())
    bound = sample_on_mesh(naked.rig.template, SamplingConfig(count=300, sh_degree=1))
    config = FitTeacherConfig(iterations=1, pretrain=None, track=TRACKING, joint=SHORT)
    teacher, progress = fit_teacher(naked, bound, TINY_TEACHER, config, Session(tmp_path))
    assert progress.finished and not (tmp_path / JOINT).exists()
    assert teacher.track is not None and teacher.track.cage.count == TRACKING.control_points


def test_another_cage_has_the_same_surface(frames):
    track = off_by(frames, 0.0)
    track = replace(track, sigma=track.controls.norm(dim=-1), drift=track.controls[0].norm(dim=-1))
    every = ControlCage(frames.rig, len(frames.rig.vertices))
    same = track.on(every)
    for frame in frames.train_frames:
        assert torch.allclose(same.displacements(frame), track.displacements(frame), atol=1e-7)
        assert torch.allclose(same.expected_error(frame), track.expected_error(frame), atol=1e-7)
    assert same.drift.shape == (every.count,)


def test_steps_follow_the_number_of_frames_and_are_shortened_with_it():
    assert (CONFIG.steps(4), CONFIG.steps(100)) == (240, 1000)
    assert CONFIG.shortened(0.5).steps(100) == 500
    # Three views a step: a third of the steps, at sqrt(3) times the rates.
    several = JointConfig().photometric(10)
    assert (several.iterations, several.views, several.attributes) == (1000, 3, pytest.approx(3**0.5))


@pytest.mark.parametrize(
    "wrong", [{"control_points": 0}, {"iterations": 0}, {"lr": 0.0}, {"smoothness": -1.0}, {"tight_reach": -0.1}]
)
def test_choices_out_of_range_are_refused(wrong):
    with pytest.raises(InputError, match="joint correction"):
        JointConfig(**wrong)


if __name__ == "__main__":
    with join_processes() as together:
        made = Path(sys.argv[1])
        if together.first:
            write_dance(made / "capture")
        together.run_on_rank0(lambda: None)
        dance = sequence(made / "capture")
        session, config = Session(made / "together", distributed=together), replace(SHORT, poses=2)
        _, corrected, _ = correct_jointly(dance, painted(), off_by(dance, 0.005), config, session)
        np.save(made / f"controls_{together.rank}.npy", corrected.controls.numpy())
