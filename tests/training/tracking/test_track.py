"""Following the surface on a doll whose dress swings: closer to the truth, resumed exactly, taught to the networks."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from avatar.data.sequence import AvatarSequence
from avatar.data.views import View
from avatar.gaussians.binding import world_from_local
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked_surface import Track, TrackedAvatar
from avatar.training.engine.optimization_task import PretrainConfig
from avatar.training.engine.processes import join_processes
from avatar.training.engine.session import Session
from avatar.training.fit_teacher import FitTeacherConfig, PretrainTeacherTask, fit_teacher
from avatar.training.tracking import track as tracking
from avatar.training.tracking.cloth_prediction import SimulatedControls
from avatar.training.tracking.config import Level, TrackConfig
from avatar.training.tracking.follow import SEAMS_FILE, Segment, follow_surface, segments_of
from avatar.training.tracking.track import TrackTask, outwards
from avatar.training.tracking.track_uncertainty import unobserved_weight
from smplxpp.core.errors import InputError
from tests.dolls.dancing import gaussians, sequence, template, true_vertices, write_dance
from tests.dolls.tiny import TINY_TEACHER
from tests.dolls.toy import copied, same_state

ROOT = Path(__file__).resolve().parents[3]
CONFIG = TrackConfig(
    levels=(Level(1, 8, 1e-2), Level(0, 8, 6e-3)),
    control_points=24,
    views=2,
    weights=ReconstructionWeights(dssim=0.0, perceptual=0.0, alpha=1.0, normal=0.0),
)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return sequence(write_dance(tmp_path_factory.mktemp("captures") / "dance"))


@pytest.fixture(scope="module")
def track(frames, tmp_path_factory) -> Track:
    found, progress = follow_surface(frames, painted(), CONFIG, Session(tmp_path_factory.mktemp("track")))
    assert progress.finished
    return found


def painted():
    """Gaussians in the colours of the photographs, as a fit would have them."""
    bound, it = gaussians(1200), template()
    where = world_from_local(bound, torch.tensor(it.vertices, dtype=torch.float32), torch.tensor(it.faces)).means
    x, y, z = where.unbind(-1)
    paint = [0.5 + 0.3 * torch.sin(30.0 * y), 0.5 + 0.4 * torch.tanh(4 * x), 0.5 + 0.4 * torch.tanh(4 * z)]
    return replace(bound, dc=torch.stack(paint, dim=-1))


def task(frames) -> TrackTask:
    return TrackTask(frames, TrackedAvatar(frames.rig, painted(), CONFIG.control_points), CONFIG)


def error(frames, frame: int, displacements=None) -> float:
    """Mean distance of the dress from where it is, metres."""
    dress = template().cloth_mask
    with torch.no_grad():
        posed = frames.rig.skin(frames.pose(frame), displacements).numpy()
    return float(np.linalg.norm((posed - true_vertices(frame))[dress], axis=1).mean())


def test_the_swing_is_found(frames, track):
    # In frames 1 and 3 the dress is 3 cm away from where skinning has it: one and a half pixels.
    for frame in (1, 3):
        assert error(frames, frame, track.displacements(frame)) < 0.5 * error(frames, frame)


@pytest.mark.long
def test_the_template_is_the_surface_of_its_own_frame(frames, tmp_path):
    found, _ = follow_surface(frames, painted(), replace(CONFIG, reference=2), Session(tmp_path))
    assert not found.displacements(2).any() and found.displacements(1).any()


@pytest.mark.long
def test_with_a_prior_the_body_stays_and_the_dress_swings(frames, track, tmp_path):
    found, _ = follow_surface(frames, painted(), replace(CONFIG, body_motion_weight=2.0), Session(tmp_path))
    body = ~torch.tensor(template().cloth_mask)
    for frame in (1, 3):
        free, held = (one.displacements(frame)[body].norm(dim=-1).mean() for one in (track, found))
        assert held < 0.5 * free
        assert error(frames, frame, found.displacements(frame)) < 0.5 * error(frames, frame)


def test_a_body_that_is_kept_still_does_not_move_and_the_dress_swings(frames, tmp_path):
    config = replace(CONFIG, still_body=True)
    found, _ = follow_surface(frames, painted(), config, Session(tmp_path))
    body = torch.tensor(template().vertex_part == 0)
    for frame in (1, 3):
        moved = found.displacements(frame)
        assert not moved[body].any()
        assert error(frames, frame, moved) < 0.5 * error(frames, frame)


def test_a_naked_body_is_followed_whole(frames):
    rig = AvatarSequence(frames.capture, template().naked()).rig
    bound = sample_on_mesh(rig.template, SamplingConfig(count=300, sh_degree=1))
    assert TrackedAvatar(rig, bound, 8, still_body=True).moves.all()


def test_cloth_on_the_skin_counts_as_the_body_and_cloth_off_it_does_not(frames):
    cage = TrackedAvatar(frames.rig, painted(), CONFIG.control_points).cage
    cloth = ~cage.off_clothes
    moved = torch.zeros(cage.count, 3)
    moved[cloth] = 0.02
    near, far = float(cage.from_body[cloth].min()), float(cage.from_body[cloth].max())
    assert not cage.from_body[cage.off_clothes].any() and far > 0.0
    assert cage.motion_off_clothes(moved) == 0.0 == cage.motion_off_clothes(moved, reach=0.5 * near)
    tight, tighter = (float(cage.motion_off_clothes(moved, reach=reach)) for reach in (2.0 * far, 20.0 * far))
    assert 0.0 < tight < tighter
    # Cloth that has left the skin by centimetres pays hardly more for going on.
    once, twice = (float(cage.motion_off_clothes(k * moved, reach=2.0 * far)) for k in (1.0, 2.0))
    first = float(cage.motion_off_clothes(0.1 * moved, reach=2.0 * far))
    assert tight == once and 0.0 < twice - once < 0.2 * first < first
    # What the body does weighs the same with it and without.
    body = torch.where(cage.off_clothes[:, None], torch.tensor(0.02), torch.tensor(0.0)).expand(-1, 3)
    assert cage.motion_off_clothes(body) == cage.motion_off_clothes(body, reach=20.0 * far)


def test_without_clothes_there_is_no_prior(frames):
    naked = AvatarSequence(frames.capture, template().naked())
    bound = sample_on_mesh(naked.rig.template, SamplingConfig(count=300, sh_degree=1))
    losses = []
    for still in (0.0, 2.0):
        made = TrackTask(naked, TrackedAvatar(naked.rig, bound, 8), replace(CONFIG, body_motion_weight=still))
        made.avatar.controls.data.fill_(0.01)
        losses.append(made.loss(made.micro_batches(0)[0])[0])
    assert torch.equal(*losses)


def test_frames_are_taken_from_the_reference_outwards(frames):
    made = TrackTask(
        frames, TrackedAvatar(frames.rig, gaussians(), CONFIG.control_points), replace(CONFIG, reference=2)
    )
    assert made.order == [2, 1, 3, 0]
    met = [made.micro_batches(k)[0].frame for k in range(0, made.config.iterations, CONFIG.steps)]
    assert met == made.order


def test_a_frame_starts_from_its_neighbours_carried_on(frames, monkeypatch):
    made = task(frames)
    first, second = torch.full_like(made.avatar.controls, 0.01), torch.full_like(made.avatar.controls, 0.03)
    made.solved[0], made.solved[1] = first, second
    monkeypatch.setattr(made, "_structure", lambda frame, start: torch.full((24, 3, 3), 1e12) * torch.eye(3))
    assert torch.equal(made.priors(0).start, torch.zeros_like(first))
    torch.testing.assert_close(made.priors(1).start, first)
    torch.testing.assert_close(made.priors(2).start, second + CONFIG.extrapolation * (second - first))


@pytest.mark.parametrize("simulates", [False, True])
def test_the_work_before_a_frame_does_not_grow_with_the_frames_before_it(frames, monkeypatch, simulates):
    """Each frame once asked for the directions that photographs determined in all frames before it."""
    made, asked = task(frames), []
    if simulates:
        count = len(made.avatar.controls)
        still = {frame: torch.zeros(count, 3) for frame in made.order}
        clothes = SimulatedControls(still, torch.ones(count), torch.ones(count, dtype=torch.int64))
        made.prediction = replace(made.prediction, simulated=clothes)
    monkeypatch.setattr(made, "_structure", lambda frame, start: torch.eye(3).expand(len(made.avatar.controls), 3, 3))
    monkeypatch.setattr(tracking, "unobserved_weight", lambda *args: asked.append(args) or unobserved_weight(*args))
    for number, frame in enumerate(made.order):
        made.priors(frame)
        # Once for the frame's own prior, and once for the frame that was solved last.
        assert len(asked) <= (2 * number if simulates else number)


def test_photographs_are_halved_once_a_frame(frames, monkeypatch):
    halved, whole = [], View.halved

    def counted(view):
        halved.append(view.name)
        return whole(view)

    monkeypatch.setattr(View, "halved", counted)
    made = task(frames)
    for k in range(2 * CONFIG.steps):
        (item,) = made.micro_batches(k)
        sizes = {(view.camera.height, len(halved)) for view in made.views(item)}
        assert len(sizes) == 1
    assert len(halved) == 2 * len(set(halved))


def test_rates_fall_within_every_level(frames):
    made = task(frames)
    group = made.groups[0]
    rates = [made.lr_factor(k, group) for k in range(2 * CONFIG.steps)]
    assert rates[0] == 1e-2 and rates[8] == 6e-3
    assert rates[:8] == sorted(set(rates[:8]), reverse=True) and len(set(rates[:8])) == 8
    assert rates[CONFIG.steps :] == rates[: CONFIG.steps]


def test_resumed_in_the_middle_of_a_frame_bit_for_bit(frames):
    whole, parts = task(frames), task(frames)
    for k in range(2 * CONFIG.steps + 3):
        whole.step(k)
    for k in range(CONFIG.steps + 2):
        parts.step(k)
    kept, parts = copied(parts.state()), task(frames)
    parts.restore(kept)
    for k in range(CONFIG.steps + 2, 2 * CONFIG.steps + 3):
        parts.step(k)
    assert same_state(whole.state(), parts.state())


@pytest.mark.long
def test_networks_learn_what_was_followed_before_they_render(frames, track):
    torch.manual_seed(0)
    teacher = TeacherAvatar(TINY_TEACHER, frames.rig, gaussians())
    learning = PretrainTeacherTask(frames, teacher, PretrainConfig(iterations=120, batch=2, lr=1e-2), 0, track)
    losses = [learning.step(k)["loss"] for k in range(120)]
    # Two steps see all frames; networks as small as these take up a tenth.
    assert np.mean(losses[-2:]) < 0.93 * np.mean(losses[:2])


@pytest.mark.long
def test_the_teacher_follows_first_within_its_time(frames, tmp_path):
    config = FitTeacherConfig(
        iterations=3,
        pretrain=PretrainConfig(iterations=1),
        views=1,
        lr=1e-3,
        weights=CONFIG.weights,
        track=CONFIG,
        evaluations=1,
        evaluated=1,
    )
    _, stopped = fit_teacher(frames, gaussians(), TINY_TEACHER, config, Session(tmp_path, max_seconds=1e-9))
    assert not stopped.finished and stopped.iterations == len(frames.train_frames) * CONFIG.steps
    _, done = fit_teacher(frames, gaussians(), TINY_TEACHER, config, Session(tmp_path))
    assert done.finished and done.iterations == 3


def test_what_was_found_is_taken_up_without_a_step(frames, track, tmp_path):
    first, _ = follow_surface(frames, painted(), CONFIG, Session(tmp_path))
    again, progress = follow_surface(frames, painted(), CONFIG, Session(tmp_path))
    assert torch.equal(first.controls, again.controls) and torch.equal(first.controls, track.controls)
    assert progress.finished and progress.session_seconds == 0.0


@pytest.mark.parametrize(
    "change",
    [
        {"levels": ()},
        {"levels": (Level(0, 0, 1e-3),)},
        {"smoothness": -1.0},
        {"body_motion_weight": -1.0},
        {"tight_reach": -1.0},
    ],
)
def test_senseless_choices_are_refused(change):
    with pytest.raises(InputError):
        TrackConfig(**change)


def test_without_a_frame_of_the_templates_nothing_is_subtracted(frames, tmp_path):
    found, _ = follow_surface(frames, painted(), CONFIG, Session(tmp_path))
    assert found.displacements(0).any()


def test_a_reference_that_is_not_trained_on_is_refused(frames):
    with pytest.raises(InputError, match="frame 99"):
        TrackTask(frames, TrackedAvatar(frames.rig, gaussians(), 24), replace(CONFIG, reference=99))


@pytest.fixture(scope="module")
def long_dance(tmp_path_factory):
    return sequence(write_dance(tmp_path_factory.mktemp("captures") / "long", 12))


QUICK = replace(CONFIG, levels=(Level(0, 6, 6e-3),), segment_frames=5, run_in=3, seam=1.0, reference=1)


def followed(frames, folder: Path, config: TrackConfig) -> torch.Tensor:
    found, progress = follow_surface(frames, painted(), config, Session(folder))
    assert progress.finished and progress.iteration == progress.iterations
    return found.controls


def seams(folder: Path) -> list:
    return json.loads((folder / SEAMS_FILE).read_text())


@pytest.fixture(scope="module")
def in_segments(long_dance, tmp_path_factory) -> tuple[torch.Tensor, Path]:
    """Ten frames in two segments, and the folder that one process left."""
    folder = tmp_path_factory.mktemp("segments")
    return followed(long_dance, folder, QUICK), folder


@pytest.mark.parametrize("reference", [0, 37, 99])
def test_segments_hold_every_frame_once_and_follow_each_other(reference):
    config = TrackConfig(segment_frames=20, run_in=5, reference=reference)
    first, *others = found = segments_of(range(100), config)
    assert sorted(frame for one in found for frame in one.frames) == list(range(100))
    assert first.frames == tuple(outwards(range(100), config)[:20]) and not first.run_in
    for one in others:
        assert len(one.frames) <= 20 and len(one.run_in) == 5
        # The run-in ends beside the segment's first frame, within the neighbour that comes before it.
        assert one.run_in[-1] in found[one.before].frames and abs(one.run_in[-1] - one.frames[0]) == 1
        assert found.index(found[one.before]) < found.index(one)


def test_a_motion_of_no_more_frames_than_a_segment_is_one():
    assert segments_of(range(250), TrackConfig()) == [Segment(tuple(range(250)))]
    assert len(segments_of(range(251), TrackConfig())) == 2


@pytest.mark.long
def test_segments_meet_at_the_seam(tmp_path, tmp_path_factory):
    """A dress that swings by 3 cm: a segment finds it nearly where its neighbour has it, without a look at that."""
    dance = sequence(write_dance(tmp_path_factory.mktemp("captures") / "longer", 14))
    found = followed(dance, tmp_path, replace(CONFIG, segment_frames=7, run_in=4, seam=1.0))
    (seam,) = seams(tmp_path)
    assert seam["frame"] == 7 and seam["frames"] == 4 and not seam["in_sequence"]
    assert found.any() and 0.0 < seam["mean_mm"] < seam["p95_mm"]
    # A pixel of these cameras is 20 mm wide.
    assert seam["mean_mm"] < 20.0


@pytest.mark.long
def test_a_segment_that_misses_its_neighbour_is_followed_after_it_to_the_same_bits(long_dance, in_segments, tmp_path):
    whole = followed(long_dance, tmp_path / "whole", replace(QUICK, segment_frames=100))
    found = followed(long_dance, tmp_path / "parts", replace(QUICK, seam=0.0))
    assert [seam["in_sequence"] for seam in seams(tmp_path / "parts")] == [True]
    assert torch.equal(found, whole) and not torch.equal(found, in_segments[0])


@pytest.mark.long
def test_a_segment_is_tracked_again_only_until_it_meets_itself(tmp_path_factory, tmp_path):
    dance = sequence(write_dance(tmp_path_factory.mktemp("captures") / "longer", 16))
    quick = replace(QUICK, segment_frames=5, run_in=2)
    free, found = (
        followed(dance, tmp_path / "free", quick),
        followed(dance, tmp_path / "found", replace(quick, seam=0.02)),
    )
    near, far = seams(tmp_path / "found")
    assert near["p95_mm"] < 20.0 < far["p95_mm"] and "again" not in near
    assert far["again"] == 2  # of its four frames
    changed = [frame for frame, (one, other) in enumerate(zip(free, found, strict=True)) if not torch.equal(one, other)]
    assert changed == [10, 11]


def test_processes_share_segments_and_find_the_bits_of_one(long_dance, in_segments, tmp_path):
    alone, folder = in_segments
    # Another process has tracked the second segment, and this one finds it.
    (tmp_path / "segments").mkdir()
    for file in (folder / "segments").glob("*_0001.npz"):
        shutil.copyfile(file, tmp_path / "segments" / file.name)
    assert torch.equal(followed(long_dance, tmp_path, QUICK), alone)
    assert (tmp_path / "segment_000").exists() and not (tmp_path / "segment_001").exists()


@pytest.mark.long
def test_segments_are_resumed_in_the_middle_of_one_bit_for_bit(long_dance, in_segments, tmp_path):
    stops = 0
    while not follow_surface(long_dance, painted(), QUICK, Session(tmp_path, max_seconds=0.2))[1].finished:
        stops += 1
    assert stops and torch.equal(followed(long_dance, tmp_path, QUICK), in_segments[0])


@pytest.mark.slow
def test_two_processes_follow_segments_to_the_bits_of_one(long_dance, in_segments, tmp_path):
    """Two real ones, started by torchrun."""
    alone, folder = in_segments
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*command, __file__, str(tmp_path)], env=environment, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr[-3000:]
    for rank in (0, 1):
        np.testing.assert_array_equal(np.load(tmp_path / f"controls_{rank}.npy"), alone.numpy())
    assert seams(tmp_path / "together") == seams(folder)


if __name__ == "__main__":
    with join_processes() as together:
        made = Path(sys.argv[1])
        if together.first:
            write_dance(made / "capture", 12)
        together.run_on_rank0(lambda: None)
        session = Session(made / "together", distributed=together)
        tracked, _ = follow_surface(sequence(made / "capture"), painted(), QUICK, session)
        np.save(made / f"controls_{together.rank}.npy", tracked.controls.numpy())
