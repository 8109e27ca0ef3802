"""Predictions of a frame: simulated clothes have weight where they were right, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace
from math import cos, exp

import numpy as np
import pytest
import torch

from avatar.data.sequence import AvatarSequence
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.tracked_surface import TrackedAvatar
from avatar.training.tracking.cloth_prediction import (
    COMPRESSION,
    CORRECTION_DECAY,
    ClothEdges,
    ClothPrediction,
    SimulatedControls,
    Solved,
    simulate_controls,
)
from avatar.training.tracking.config import Level, TrackConfig
from avatar.training.tracking.track import TrackTask
from smplxpp.capture import open_capture
from smplxpp.cloth import cut_garment
from smplxpp.cloth.calibrate import with_values
from smplxpp.core.labels import LOWER
from tests.cloth.persons import person, standing
from tests.dolls.skirted import moved, write_skirted
from tests.dolls.toy import copied, same_state

FPS = 10.0
POINTS = 6


def swung(frame: int, late: float = 0.0) -> torch.Tensor:
    """Cloth that swings to a side, 3 cm and back in 0.6 s."""
    way = 0.03 * (1.0 - cos(10.5 * (frame - late) / FPS))
    return torch.tensor([way, 0.0, 0.0]).expand(POINTS, 3)


def simulated(late: float = 0.0, *, scale: float = 1.0) -> SimulatedControls:
    """Three points of a part that can be simulated wholly, one that hangs where it begins, two of the body."""
    share = torch.tensor([1.0, 1.0, 1.0, 0.2, 0.0, 0.0])
    part = torch.tensor([1, 1, 1, 1, 0, 0])
    return SimulatedControls({f: scale * share[:, None] * swung(f, late) for f in range(12)}, share, part)


def solved(count: int) -> Solved:
    return {frame: (swung(frame), None) for frame in range(count)}


def start_error(prediction: ClothPrediction, frame: int = 8) -> float:
    return float((prediction.start(frame, solved(frame)) - swung(frame))[:3].norm(dim=-1).mean())


def test_simulated_clothes_predict_a_swing_that_extrapolation_misses():
    extrapolated, predicted = (
        start_error(ClothPrediction(1.0, fps=FPS)),
        start_error(ClothPrediction(1.0, simulated(), 0, fps=FPS)),
    )
    assert predicted < 0.1 * extrapolated
    late = start_error(ClothPrediction(1.0, simulated(0.2), 0, fps=FPS))
    assert predicted < late < 0.6 * extrapolated


def test_simulations_with_large_errors_have_little_weight():
    nonsense = simulated(3.0, scale=6.0)
    wrong, right, none = (
        ClothPrediction(1.0, one, 0, fps=FPS).anchor(8, solved(8)) for one in (nonsense, simulated(), None)
    )
    assert (wrong - none)[:3].norm(dim=-1).max() < 0.1 * nonsense.displacements[8][0].norm()
    torch.testing.assert_close(right[:3], swung(8)[:3], rtol=0.05, atol=0.0)
    assert start_error(ClothPrediction(1.0, nonsense, 0, fps=FPS)) < 1.3 * start_error(ClothPrediction(1.0, fps=FPS))


def test_points_without_a_simulation_are_extrapolated():
    start = ClothPrediction(1.0, simulated(), 0, fps=FPS).start(8, solved(8))
    extrapolated = ClothPrediction(1.0, fps=FPS).start(8, solved(8))
    assert torch.equal(start[4:], extrapolated[4:])
    assert not torch.equal(start[:3], extrapolated[:3])


def test_anchors_decay_to_skinning_where_nothing_is_simulated():
    drifted = {frame: (torch.tensor([0.01, 0.0, 0.0]).expand(POINTS, 3), None) for frame in range(4)}
    anchor = ClothPrediction(1.0, fps=FPS).anchor(5, drifted)
    torch.testing.assert_close(anchor, exp(-2 / FPS / CORRECTION_DECAY) * drifted[3][0])
    # What was found where the template is the surface is no motion and stays.
    at_rest = ClothPrediction(1.0, reference=0, fps=FPS).anchor(5, drifted)
    torch.testing.assert_close(at_rest, drifted[3][0])
    simulated_too = ClothPrediction(1.0, simulated(), 0, fps=FPS).anchor(8, solved(8))
    torch.testing.assert_close(simulated_too[:3], swung(8)[:3], rtol=1e-3, atol=0.0)


def test_the_error_of_the_reference_stays_in_all_frames():
    error = torch.tensor([0.0, 0.01, 0.0])
    found = {frame: (one + error, None) for frame, (one, _) in solved(8).items()}
    moved = ClothPrediction(1.0, simulated(), 0, fps=FPS).start(8, found)
    torch.testing.assert_close(moved, ClothPrediction(1.0, simulated(), 0, fps=FPS).start(8, solved(8)) + error)


def test_errors_are_compared_on_each_side_of_the_reference_alone():
    prediction = ClothPrediction(1.0, simulated(), 5, fps=FPS)
    found = {frame: (swung(frame), None) for frame in (5, 4, 6, 3, 7)}
    assert prediction._recent(8, found) == [7, 6] and prediction._recent(2, found) == [3, 4]
    forth = prediction.start(8, found)
    assert float((forth - swung(8))[:3].norm(dim=-1).mean()) < 0.01


@pytest.fixture(scope="module")
def skirt() -> SimulatedControls:
    poses = {k: standing(lifted=0.05 * k) for k in range(0, 12, 2)}
    controls = torch.arange(0, person().vertex_count, 7)
    made = simulate_controls(person(), poses, 20.0, reference=standing(), controls=controls)
    assert made is not None
    return made


def test_a_skirt_is_simulated_through_every_second_frame(skirt):
    assert sorted(skirt.displacements) == list(range(0, 12, 2))
    controls = torch.arange(0, person().vertex_count, 7)
    of_skirt = torch.tensor(person().vertex_part)[controls] == person().part_names.index(LOWER.name)
    assert torch.equal(skirt.part > 0, of_skirt) and not skirt.share[~of_skirt].any() and skirt.share.max() == 1.0
    last = skirt.displacements[10]
    assert not last[~of_skirt].any() and last.abs().max() > 5e-3


def test_strain_is_of_edges_along_the_cloth():
    garment = cut_garment(person(), LOWER.name, standing())
    edges = ClothEdges.of([garment], torch.device("cpu"))
    at_rest = torch.tensor(person().pose(standing())[0], dtype=torch.float32)
    lengths, kept = garment.lengths, ~garment.pinned[garment.rest.edges].all(axis=1)
    assert 0 < kept.sum() < len(kept)
    np.testing.assert_array_equal(edges.ends.numpy(), garment.particles[garment.rest.edges[kept]])
    np.testing.assert_allclose(edges.lengths.numpy(), lengths[kept], rtol=1e-6)
    # The skirt is smooth, so that its edges are hardly shorter than the way along it.
    assert float(edges.strain(at_rest)) < 1e-4
    stretched, pressed = (float(edges.strain(scale * at_rest)) for scale in (1.1, 0.9))
    assert stretched == pytest.approx(0.01, rel=0.1) and pressed == pytest.approx(COMPRESSION * 0.01, rel=0.1)


def test_clothes_that_the_body_carries_wholly_have_no_strain():
    carried = with_values(cut_garment(person(), LOWER.name, standing()), drag=2.5, pin_depth=10.0)
    edges = ClothEdges.of([carried], torch.device("cpu"))
    assert not len(edges.ends)
    assert float(edges.strain(torch.tensor(person().vertices, dtype=torch.float32))) == 0.0


@pytest.mark.long
def test_frames_numbers_are_names():
    poses = {k: standing(lifted=0.1 * k) for k in range(3)}
    apart = {10 + 3 * k: pose for k, pose in poses.items()}
    controls = torch.arange(0, person().vertex_count, 7)
    one = simulate_controls(person(), poses, 10.0, reference=standing(), controls=controls)
    other = simulate_controls(person(), apart, 30.0, reference=standing(), controls=controls)
    assert one is not None and other is not None
    for k in poses:
        assert torch.equal(one.displacements[k], other.displacements[10 + 3 * k])


def test_clothes_that_hang_from_nothing_are_left_out():
    controls = torch.arange(0, 20)
    poses = {0: standing()}
    loose = person(tight=False)
    assert simulate_controls(loose, poses, 10.0, reference=standing(), controls=controls) is None


CONFIG = TrackConfig(
    levels=(Level(0, 2, 5e-3),),
    control_points=40,
    views=1,
    weights=ReconstructionWeights(dssim=0.0, perceptual=0.0, alpha=1.0, normal=0.0),
    reference=0,
)


@pytest.fixture(scope="module")
def skirted(tmp_path_factory) -> AvatarSequence:
    return AvatarSequence(open_capture(write_skirted(tmp_path_factory.mktemp("captures") / "skirt")), person())


def task(sequence: AvatarSequence, **changes) -> TrackTask:
    bound = sample_on_mesh(person(), SamplingConfig(count=200, sh_degree=0))
    config = replace(CONFIG, **changes)
    return TrackTask(sequence, TrackedAvatar(sequence.rig, bound, config.control_points), config)


@pytest.mark.long
def test_frames_of_a_capture_start_nearer_to_a_skirt_that_swings(skirted):
    wrong = {}
    for simulate in (True, False):
        made = task(skirted, simulate=simulate)
        rows = made.avatar.cage.vertices.numpy()
        true = torch.tensor(moved()[:, rows], dtype=torch.float32)
        for frame in skirted.train_frames:
            made.solved[made.row[frame]] = true[frame]
        begins = {frame: made.priors(frame) for frame in made.order[3:]}
        wrong[simulate] = sum(float((one.start - true[frame]).norm(dim=-1).mean()) for frame, one in begins.items())
        assert (begins[5].rest_shape.abs().max() > 1e-3) == simulate
    assert wrong[True] < 0.7 * wrong[False]


def test_without_a_reference_nothing_is_simulated(skirted):
    assert task(skirted, reference=None).prediction.simulated is None


@pytest.mark.long
def test_clothes_that_are_followed_hardly_stretch(skirted):
    strains = {}
    for weight in (0.0, 1.0, 20.0):
        made = task(skirted, strain_weight=weight, levels=(Level(0, 8, 5e-3),), control_points=200)
        for k in range(3 * made.track_config.steps):
            made.step(k)
        simulated, frame = made.prediction.simulated, made.order[2]
        assert simulated is not None and simulated.edges is not None
        posed = skirted.rig.skin(skirted.pose(frame), made.avatar.cage(made.solved[made.row[frame]]))
        strains[weight] = float(simulated.edges.strain(posed))
    assert strains[20.0] < 0.7 * strains[1.0] < strains[0.0]


@pytest.mark.long
def test_resumed_with_simulated_clothes_bit_for_bit(skirted):
    whole, parts = task(skirted), task(skirted)
    for k in range(9):
        whole.step(k)
    for k in range(5):
        parts.step(k)
    kept, parts = copied(parts.state()), task(skirted)
    parts.restore(kept)
    for k in range(5, 9):
        parts.step(k)
    assert same_state(whole.state(), parts.state())
