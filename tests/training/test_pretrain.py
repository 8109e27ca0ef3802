"""Pretraining on a doll: what is known is learned without rendering, resumed exactly, left out where needless."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.models.student import Student, StudentConfig
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked_surface import ControlCage, Track
from avatar.rig.rig import Rig
from avatar.training.engine.loop import METRICS_FILE
from avatar.training.engine.metrics_log import read_metrics
from avatar.training.engine.optimization_task import OptimizationTask, PretrainConfig
from avatar.training.engine.session import PRETRAIN, TRACK, Session
from avatar.training.fit_teacher import FitTeacherConfig, PretrainTeacherTask, fit_teacher
from avatar.training.student.bake import BakeConfig, bake
from avatar.training.student.pretrain import PretrainFieldTask, _MapLookup
from avatar.training.tracking.config import Level
from smplxpp.core.errors import InputError
from tests.dolls.dancing import gaussians, sequence, template, write_dance
from tests.dolls.tiny import TINY_FIELD, TINY_TEACHER
from tests.dolls.toy import copied, same_state
from tests.training.engine.test_photometric_tasks import BAKE, TEACHER
from tests.training.tracking.test_track import CONFIG as TRACKING

CONFIG = PretrainConfig(iterations=40, batch=2, lr=1e-2)
APART = replace(TINY_TEACHER, bottleneck=2, position_size=16, centred=True)
STUDENT = StudentConfig(field=TINY_FIELD, control_points=40)
TASKS = ("displacements", "zero residuals", "field")
ONE_STEP = 1e-12
"""Seconds after which a training stops: with its first step."""


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return sequence(write_dance(tmp_path_factory.mktemp("captures") / "dance"))


@pytest.fixture(scope="module")
def track(frames) -> Track:
    """To one side in all frames, farther in some, the same everywhere on the template."""
    cage = ControlCage(frames.rig, 24)
    swing = torch.tensor([[0.03, 0.0, 0.0], [0.03, 0.01, 0.0], [0.04, 0.0, 0.0], [0.03, 0.0, 0.01]])
    return Track({frame: row for row, frame in enumerate(frames.train_frames)}, swing[:, None].expand(-1, 24, -1), cage)


def make_teacher(frames, config=APART, *, moved: float = 0.0) -> TeacherAvatar:
    """A teacher from the same start every time; `moved`: with something to say."""
    torch.manual_seed(0)
    teacher = TeacherAvatar(config, frames.rig, gaussians())
    teacher.centre(frames.pose(frame) for frame in frames.train_frames)
    with torch.no_grad():
        for value in teacher.networks.parameters():
            value.add_(moved * torch.randn(value.shape))
    return teacher


def make(kind: str, frames, track, config=CONFIG, **changes) -> OptimizationTask:
    """A task from the same start every time."""
    if kind == "displacements":
        return PretrainTeacherTask(frames, make_teacher(frames), config, 0, track)
    if kind == "zero residuals":
        return PretrainTeacherTask(frames, make_teacher(frames, replace(APART, zero_output=False)), config, 0, None)
    teacher = make_teacher(frames, moved=0.05)
    student = Student(STUDENT, frames.rig, gaussians(), frames.train_frames)
    options = {"code_lr_factor": 5.0, "null_share": 0.25, **changes}
    return PretrainFieldTask(frames, student, teacher, config, 0, **options)


def steps(task, count: int, start: int = 0) -> list[float]:
    return [task.step(k)["loss"] for k in range(start, start + count)]


@pytest.mark.parametrize("kind", TASKS)
def test_the_loss_falls(kind, frames, track):
    losses = steps(make(kind, frames, track), 24)
    assert np.mean(losses[-4:]) < 0.85 * np.mean(losses[:4])


@pytest.mark.parametrize("kind", TASKS)
@pytest.mark.long
def test_a_restored_state_goes_on_bit_for_bit(kind, frames, track):
    whole, before = make(kind, frames, track), make(kind, frames, track)
    steps(whole, 5)
    steps(before, 3)
    after = make(kind, frames, track)
    after.restore(copied(before.state()))
    steps(after, 2, start=3)
    assert same_state(whole.state(), after.state())


@pytest.mark.parametrize("kind", TASKS)
def test_every_pose_comes_once_an_epoch_in_another_order(kind, frames, track):
    task = make(kind, frames, track)
    poses = len(frames.train_frames)
    per_epoch = poses // CONFIG.batch
    epochs = [
        [n for k in range(e * per_epoch, (e + 1) * per_epoch) for n in task.micro_batches(k)[0]] for e in range(6)
    ]
    assert all(sorted(epoch) == list(range(poses)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1


def test_no_pose_comes_twice_where_batches_leave_some_over(frames, track):
    task = make("displacements", frames, track, replace(CONFIG, batch=3))
    assert all(len(set(task.micro_batches(k)[0])) == 3 for k in range(8))
    assert {n for k in range(8) for n in task.micro_batches(k)[0]} == {0, 1, 2, 3}
    assert make("displacements", frames, track, replace(CONFIG, batch=99)).batch == 4


@pytest.mark.parametrize("kind", TASKS)
def test_a_batch_costs_the_mean_of_its_poses(kind, frames, track):
    task = make(kind, frames, track, null_share=0.0)
    task.micro_batches(0)
    both, *single = (float(task.loss(item)[0].detach()) for item in ((1, 3), (1,), (3,)))
    assert both == pytest.approx(np.mean(single), rel=1e-5)


def test_known_displacements_move_the_position_alone(frames, track):
    task = make("displacements", frames, track)
    others = copied(task.teacher.networks.networks["all"].state_dict())
    steps(task, 2)
    assert same_state(others, task.teacher.networks.networks["all"].state_dict())


def test_one_network_for_all_keeps_its_other_residuals_at_zero(frames, track):
    teacher = make_teacher(frames, TINY_TEACHER)
    steps(PretrainTeacherTask(frames, teacher, CONFIG, 0, track), 3)
    with torch.no_grad():
        maps = teacher.residual_maps(frames.pose(1), torch.zeros(1, 3))
    assert maps.position.abs().max() > 0 and maps.shape[..., 3:].abs().max() == 0 and maps.colour.abs().max() == 0


@pytest.mark.long
def test_the_teacher_comes_to_what_is_known(frames, track):
    teacher = make_teacher(frames)
    steps(PretrainTeacherTask(frames, teacher, replace(CONFIG, batch=4), 0, track), 40)
    with torch.no_grad():
        for frame in frames.train_frames:
            found = teacher.sampler(teacher.displacement_maps([frames.pose(frame)]))[0]
            known = track.displacements(frame)[0]  # the same everywhere
            assert (found - known).norm(dim=-1).mean() < 0.5 * known.norm()


def test_the_field_comes_to_the_teachers_displacements_at_its_points(frames, track):
    task = make("field", frames, track, null_share=0.0)
    lookup = _MapLookup(task.teacher, task.student.field.points)

    def error() -> float:
        with torch.no_grad():
            differences = [
                task.student.displacements(pose)[task.student.field.points]
                - lookup(task.teacher.displacement_maps([pose]))[0]
                for pose in map(frames.pose, frames.train_frames)
            ]
        return float(torch.stack(differences).norm(dim=-1).mean())

    before = error()
    steps(task, 40)
    assert error() < 0.85 * before


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_share_of_the_poses_is_shown_with_the_null_code(share, frames, track, monkeypatch):
    task, shown = make("field", frames, track, null_share=share), []
    codes = task.student.codes.forward
    monkeypatch.setattr(task.student.codes, "forward", lambda which: shown.append(which) or codes(which))
    task.loss((0, 3, 2))
    assert shown == [[None] * 3 if share else [0, 3, 2]]
    assert task.name_of((0, 3)) == "poses 0 3"


def test_the_bakes_teacher_stays_as_it_is(frames, track):
    task = make("field", frames, track)
    before = copied(task.teacher.state_dict())
    steps(task, 2)
    assert same_state(before, task.teacher.state_dict())
    assert all(value.grad is None for value in task.teacher.parameters())


def hidden_stay(rig: Rig) -> torch.Tensor:
    """(V,) bool: vertices that a map that moves everything leaves where they are."""
    fine = replace(TINY_TEACHER, in_size=128, out_size=256, channel_base=128)
    lookup = _MapLookup(TeacherAvatar(fine, rig, gaussians()), torch.arange(len(rig.vertices)))
    moved = lookup(torch.full((1, 2, 256, 256, 3), 0.03))[0].abs().amax(dim=-1)
    assert bool(((moved == 0) | ((moved - 0.03).abs() < 1e-6)).all())
    return moved == 0


def test_skin_under_clothes_stays(frames):
    it = template()
    stays = hidden_stay(frames.rig).numpy()
    assert not stays[it.cloth_mask].any()
    torso, head = np.split(np.flatnonzero(it.vertex_part == 0), 2)
    under = torso[(np.abs(it.vertices[torso, 1] - 0.3) < 0.15) & (np.abs(it.vertices[torso, 2]) > 0.08)]
    seen = head[np.abs(it.vertices[head, 2]) > 0.05]
    assert len(under) > 5 and stays[under].all()
    assert len(seen) > 5 and not stays[seen].any()


def test_what_is_hidden_does_not_depend_on_where_the_body_stands(frames):
    it = template()
    away = replace(it, vertices=it.vertices + [0.0, 0.0, -0.6])
    assert (hidden_stay(Rig(away)) == hidden_stay(frames.rig)).float().mean() > 0.99


def short(**changes) -> FitTeacherConfig:
    return replace(TEACHER, iterations=1, evaluations=1, pretrain=replace(CONFIG, iterations=2), **changes)


def test_networks_that_start_at_zero_need_no_pretraining_without_a_track(frames, tmp_path):
    for zero, folder in ((True, tmp_path / "zero"), (False, tmp_path / "random")):
        _, done = fit_teacher(frames, gaussians(), replace(APART, zero_output=zero), short(), Session(folder))
        assert done.finished and done.iterations == 1 and (folder / PRETRAIN).exists() != zero


@pytest.mark.long
def test_a_teacher_stopped_in_its_pretraining_ends_with_the_same_weights(frames, tmp_path):
    config = short(track=replace(TRACKING, levels=(Level(1, 1, 6e-3),), control_points=12))
    whole, done = fit_teacher(frames, gaussians(), APART, config, Session(tmp_path / "whole"))
    assert done.finished
    folder, sessions = tmp_path / "parts", 0
    shutil.copytree(tmp_path / "whole" / TRACK, folder / TRACK)
    done = None
    while done is None or not done.finished:
        parts, done = fit_teacher(frames, gaussians(), APART, config, Session(folder, max_seconds=ONE_STEP))
        sessions += 1
        assert done.iterations == (2 if sessions == 1 else 1)
    assert sessions == 3
    assert same_state(whole.state_dict(), parts.state_dict())


@pytest.mark.parametrize("regression", [False, True])
def test_a_bake_stopped_in_its_pretraining_ends_with_the_same_weights(regression, frames, tmp_path):
    pretrain = replace(CONFIG, iterations=2)
    config: BakeConfig = replace(BAKE, iterations=1, evaluations=1, pretrain=pretrain, regression=regression)
    ends = []
    for folder, seconds in ((tmp_path / "whole", float("inf")), (tmp_path / "parts", ONE_STEP)):
        done = None
        while done is None or not done.finished:
            session = Session(folder, max_seconds=seconds)
            teacher = make_teacher(frames, moved=0.05)
            student, done = bake(frames, gaussians(), STUDENT, config, session, teacher=teacher)
        assert read_metrics(folder / PRETRAIN / METRICS_FILE)[-1]["iteration"] == 2
        ends.append(student.state_dict())
    assert same_state(*ends) and ("regression.level" in ends[0]) == regression


def test_new_poses_of_a_bake_have_the_regression_and_its_frames_their_codes(frames, tmp_path, caplog):
    config = replace(BAKE, iterations=2, evaluations=1, pretrain=CONFIG, regression=True)
    with caplog.at_level("INFO", logger="avatar.training.student.regress_poses"):
        teacher = make_teacher(frames, moved=0.05)
        student, _ = bake(frames, gaussians(), STUDENT, config, Session(tmp_path), teacher=teacher)
    labels = np.unique(frames.rig.template.vertex_labels[student.field.points.numpy()])
    assert len(caplog.records) == 2 * len(labels)  # when the bake begins and when it ends
    assert "mm in left-out training frames" in caplog.text
    seen = frames.pose(2)
    with torch.no_grad():
        own, new = student.displacements(seen), student.displacements(seen.without_code())
        coded = student.field(seen.body_pose[None], student.codes([2]))[0]
        regressed = student.field.spread(student.regression(seen.body_pose[None]))[0]
        mean = torch.stack([student.displacements(frames.pose(frame)) for frame in frames.train_frames]).mean(0)
    assert torch.equal(own, coded) and torch.equal(new, regressed) and not torch.allclose(own, new, atol=1e-6)
    still = student.regression(student.regression.center[None])
    torch.testing.assert_close(student.field.spread(still)[0], mean, atol=1e-5, rtol=1e-3)


def test_a_bake_without_a_teacher_has_nothing_to_pretrain_on(frames, tmp_path):
    config = replace(BAKE, iterations=1, evaluations=1, pretrain=CONFIG)
    _, done = bake(frames, gaussians(), STUDENT, config, Session(tmp_path), teacher=None)
    assert done.finished and not (tmp_path / PRETRAIN).exists()


@pytest.mark.parametrize("kind", TASKS)
def test_nothing_is_measured_as_reports_expect_it(kind, frames, track):
    assert make(kind, frames, track).evaluate(0) == {"mean": {}}


def test_a_share_of_the_steps():
    assert CONFIG.shortened(0.25) == replace(CONFIG, iterations=10)
    assert CONFIG.shortened(1e-9).iterations == 1


@pytest.mark.parametrize("change", [{"iterations": 0}, {"batch": 0}, {"warmup": -1}])
def test_senseless_choices_are_refused(change):
    with pytest.raises(InputError, match=next(iter(change))):
        replace(CONFIG, **change)


def test_points_that_were_followed_badly_do_not_tell(frames, track):
    """Networks and field hear nothing of points that are expected to be wrong by a metre."""
    lost = torch.arange(24) % 2 == 0
    wrong = torch.where(lost[:, None], track.controls + 0.2, track.controls)
    sigma = torch.where(lost, 1.0, 0.0).expand(len(wrong), -1)
    for kind in ("displacements", "field"):
        losses = {}
        for told in (None, sigma):
            teachers = []
            for controls in (track.controls, wrong):
                own = replace(track, controls=controls, sigma=told)
                task = make(kind, frames, own)
                task.teacher.remember(own)
                teachers.append(float(task.loss(task.micro_batches(0)[0])[0].detach()))
            losses[told is None] = abs(teachers[0] - teachers[1])
        assert losses[False] < 0.5 * losses[True]
