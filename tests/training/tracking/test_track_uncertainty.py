"""Structure tensors, the prior's weight and expected errors of a track, and the backward pass."""

from __future__ import annotations

from dataclasses import replace
from math import exp, sqrt

import numpy as np
import pytest
import torch

from avatar.data.sequence import AvatarSequence
from avatar.gaussians.binding import world_from_local
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.tracked_surface import Track, TrackedAvatar
from avatar.training.engine.session import Session
from avatar.training.tracking.cloth_prediction import CORRECTION_DECAY
from avatar.training.tracking.config import Level
from avatar.training.tracking.follow import follow_surface
from avatar.training.tracking.track import TrackTask
from avatar.training.tracking.track_uncertainty import (
    OBSERVED_GRADIENT,
    REFERENCE_SIGMA,
    SHADING_SIGMA,
    SIMULATION_SHARE,
    expected_errors,
    structure_tensors,
    unobserved_weight,
)
from smplxpp.capture import open_capture
from tests.cloth.persons import person
from tests.dolls.dancing import doll, gaussians, sequence, template
from tests.dolls.doll import paint
from tests.dolls.skirted import moved, write_skirted
from tests.training.tracking.test_track import CONFIG

STRIPED, PLAIN = 40.0, 0.0
PRIOR = replace(CONFIG, levels=(Level(0, 12, 8e-3),), reference=0)


def painted(stripes: float):
    """Gaussians in the colours of the photographs."""
    bound, it = gaussians(1200), template()
    where = world_from_local(bound, torch.tensor(it.vertices, dtype=torch.float32), torch.tensor(it.faces)).means
    return replace(bound, dc=torch.tensor(paint(where.numpy(), stripes), dtype=torch.float32))


@pytest.fixture(scope="module")
def dances(tmp_path_factory) -> dict[float, AvatarSequence]:
    """The doll in stripes, hoops around it, and in plain colours."""
    root = tmp_path_factory.mktemp("captures")
    return {
        stripes: sequence(replace(doll(), stripes=stripes).write_capture(root / f"{stripes:g}"))
        for stripes in (STRIPED, PLAIN)
    }


@pytest.fixture(scope="module")
def tracks(dances, tmp_path_factory) -> dict[float, Track]:
    found = {}
    for stripes, frames in dances.items():
        config = replace(PRIOR, back=stripes == STRIPED)
        found[stripes], progress = follow_surface(
            frames, painted(stripes), config, Session(tmp_path_factory.mktemp("track"))
        )
        assert progress.finished
    return found


def structure(frames: AvatarSequence, stripes: float, cameras: tuple[str, ...]) -> tuple[torch.Tensor, TrackedAvatar]:
    avatar = TrackedAvatar(frames.rig, painted(stripes), 48)
    views = [frames.view(camera, 0) for camera in cameras]
    still = torch.zeros_like(avatar.controls)
    return structure_tensors(avatar, still, frames.pose(0), views, frames.background, halvings=0), avatar


def test_the_prior_acts_where_contrast_is_low_alone():
    information = torch.diag(torch.tensor([0.0, OBSERVED_GRADIENT**2, 100.0 * OBSERVED_GRADIENT**2]))[None]
    weight = unobserved_weight(information, torch.zeros(1, 3))[0].diagonal()
    torch.testing.assert_close(weight, torch.tensor([1.0, 0.25, 1e-8]), rtol=1e-3, atol=1e-8)


def test_the_prior_acts_along_the_surface_alone():
    normal = torch.nn.functional.normalize(torch.tensor([[1.0, 2.0, -2.0]]), dim=-1)
    weight = unobserved_weight(torch.zeros(1, 3, 3), normal)[0]
    torch.testing.assert_close(weight @ normal[0], torch.zeros(3), atol=1e-6, rtol=0)
    torch.testing.assert_close(torch.linalg.eigvalsh(weight), torch.tensor([0.0, 1.0, 1.0]), atol=1e-6, rtol=0)


def test_expected_errors_of_unseen_and_seen_points_are_the_kalman_filters():
    blind, seen = torch.zeros(1, 3, 3), 4.0 * SHADING_SIGMA**2 / REFERENCE_SIGMA**2 * torch.eye(3)[None]
    order, step, swing = [0, 1, 2, 60], 0.1, torch.tensor([0.03])
    unseen = expected_errors(order, step, {frame: blind for frame in order}, swing, known=True)
    kept, astray = exp(-2.0 * step / CORRECTION_DECAY), SIMULATION_SHARE * 0.03 + REFERENCE_SIGMA
    once = sqrt(3.0 * (kept * REFERENCE_SIGMA**2 + (1.0 - kept) * astray**2))
    assert float(unseen[0]) == pytest.approx(sqrt(3.0) * REFERENCE_SIGMA) and float(unseen[1]) == pytest.approx(once)
    assert unseen[1] < unseen[2] < unseen[60] and float(unseen[60]) == pytest.approx(sqrt(3.0) * astray)
    information = expected_errors(order, step, {frame: seen for frame in order}, swing, known=True)
    assert max(map(float, information.values())) < 0.5 * sqrt(3.0) * REFERENCE_SIGMA
    lost = expected_errors(order, step, {frame: blind for frame in order}, swing, known=False)
    assert float(lost[0]) == pytest.approx(sqrt(3.0) * astray)


def test_stripes_determine_the_direction_across_them_and_plain_cloth_none(dances):
    cameras = tuple(dances[STRIPED].train_cameras)
    across, along = {}, {}
    for stripes in (STRIPED, PLAIN):
        information, avatar = structure(dances[stripes], stripes, cameras)
        dress = information[~avatar.cage.off_clothes]
        across[stripes], along[stripes] = dress[:, 1, 1].median(), torch.linalg.eigvalsh(dress)[:, 0].median()
    assert across[STRIPED] > 2.0 * across[PLAIN]
    assert across[STRIPED] > 2.0 * along[STRIPED]


def test_structure_tensors_of_hidden_points_are_near_zero(dances):
    (camera,) = (name for name in dances[STRIPED].train_cameras if name == "Ring0")
    information, avatar = structure(dances[STRIPED], STRIPED, (camera,))
    rig, towards = dances[STRIPED].rig, dances[STRIPED].capture.cameras[camera].position
    posed = rig.skin(dances[STRIPED].pose(0))[avatar.cage.vertices]
    side = (posed - posed.mean(0)) @ torch.tensor(towards / np.linalg.norm(towards), dtype=torch.float32)
    size = information.diagonal(dim1=1, dim2=2).sum(-1)
    hidden, shown = size[side < side.quantile(0.2)], size[side > side.quantile(0.8)]
    assert hidden.min() < 0.01 * shown.min()


@pytest.mark.long
def test_expected_errors_of_a_plain_skirt_are_larger_and_rank_its_true_errors(tmp_path):
    """Compare expected and true errors of a swinging hem, striped and plain."""
    from scipy.stats import spearmanr  # importing it takes half a second

    found, wrong = {}, []
    for stripes in (STRIPED, PLAIN):
        frames = AvatarSequence(open_capture(write_skirted(tmp_path / f"{stripes:g}", stripes=stripes)), person())
        bound = sample_on_mesh(person(), SamplingConfig(count=1500, sh_degree=0))
        where = world_from_local(bound, frames.rig.vertices, frames.rig.faces).means
        bound = replace(bound, dc=torch.tensor(paint(where.numpy(), stripes), dtype=torch.float32))
        config = replace(PRIOR, levels=(Level(0, 4, 5e-3),), control_points=60)
        found[stripes], _ = follow_surface(frames, bound, config, Session(tmp_path / f"track{stripes:g}"))
    skirt = torch.tensor(person().cloth_mask)
    expected, ratios = [], []
    for frame in frames.train_frames[1:]:
        striped, plain = (found[stripes].expected_error(frame)[skirt] for stripes in (STRIPED, PLAIN))
        ratios.append(float(plain.mean() / striped.mean()))
        expected.append(plain)
        truth = torch.tensor(moved()[frame], dtype=torch.float32)
        wrong.append((found[PLAIN].displacements(frame) - truth)[skirt].norm(dim=-1))
    # Least in the first frame, in which the skirt, whose edges are bounded, has swung least.
    assert min(ratios) > 1.15 and np.mean(ratios) > 1.2
    assert spearmanr(torch.cat(expected), torch.cat(wrong))[0] > 0.3


@pytest.mark.parametrize(
    ("reference", "ends", "order"), [(0, (3,), [2, 1, 0]), (2, (0, 3), [1, 2]), (3, (0,), [1, 2, 3])]
)
def test_the_backward_pass_starts_from_the_displacements_of_the_ends(dances, reference, ends, order):
    avatar = TrackedAvatar(dances[STRIPED].rig, painted(STRIPED), CONFIG.control_points)
    config = replace(PRIOR, reference=reference, prior_weight=0.0)
    forward = TrackTask(dances[STRIPED], avatar, config)
    forward.solved[:] = torch.randn(forward.solved.shape, generator=torch.Generator().manual_seed(1))
    back = TrackTask(dances[STRIPED], avatar, config.coarse(), apart=forward.backward())
    assert (back.known, back.order) == (ends, order) and back.config.iterations == len(order) * config.steps
    nearest = min(ends, key=lambda end: abs(end - order[0]))
    torch.testing.assert_close(back.priors(order[0]).start, forward.solved[nearest])
    back.solved[reference] = forward.solved[reference] + torch.tensor([0.0, 0.03, 0.04])
    torch.testing.assert_close(forward.drift(back), torch.full((CONFIG.control_points,), 0.05))


def test_drift_is_measured_where_it_was_requested(tracks):
    assert tracks[PLAIN].drift is None
    drift = tracks[STRIPED].drift
    assert drift.shape == (CONFIG.control_points,) and drift.isfinite().all() and drift.any()


@pytest.mark.long
def test_a_stopped_backward_pass_continues_bit_for_bit(dances, tracks, tmp_path):
    config, frames = replace(PRIOR, back=True), dances[STRIPED]
    stops = 0
    while True:
        track, progress = follow_surface(frames, painted(STRIPED), config, Session(tmp_path, max_seconds=1e-9))
        if progress.finished and track.drift is not None:
            break
        stops += 1
        if stops == 2:
            track, progress = follow_surface(frames, painted(STRIPED), config, Session(tmp_path))
            break
    assert stops == 2 and progress.finished
    assert torch.equal(track.controls, tracks[STRIPED].controls) and torch.equal(track.drift, tracks[STRIPED].drift)
