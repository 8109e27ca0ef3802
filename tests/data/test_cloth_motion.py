"""Clothes simulated along a capture's frames: which frames, from where on, and what training is spared."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from avatar.data.cloth_motion import ClothMotionConfig, ClothMotions
from avatar.data.sequence import AvatarSequence
from smplxpp.capture import open_capture
from smplxpp.cloth import ClothDriver, ClothShape
from smplxpp.cloth.calibrate import with_values
from smplxpp.core import BodyParams, GeometryWarning, InputError
from tests.cloth.persons import PART, person, standing
from tests.cloth.test_driver import QUICK, garment, in_the_world
from tests.dolls.dancing import NOVEL_POSES, dance, template, write_dance

FPS = 60.0


def pose(frame: float) -> BodyParams:
    t = frame / FPS
    return standing(at=(0.15 * np.sin(3 * t) ** 2, 0.0, 0.1 * t), lifted=0.3 * np.sin(2 * t) ** 2)


def shaken(frame: int) -> BodyParams:
    off = 0.004 * np.random.default_rng(frame).normal(size=3)
    return standing(at=tuple(pose(frame).transl[0] + off), lifted=0.3 * np.sin(2 * frame / FPS) ** 2)


def motions(params=pose, *, count: int = 60, fps: float = FPS, **config) -> ClothMotions:
    seen = {"seen": config.pop("seen")} if "seen" in config else {}
    config = ClothMotionConfig(**{"smoothing": 0.0, "pre_roll": 0.2, "driver": QUICK, **config})
    return ClothMotions(person(), [garment()], params=params, frames=range(count), fps=fps, config=config, **seen)


def stepped(frames: range, params=pose) -> list[ClothShape]:
    """What a driver says of frames that it begins with the first of."""
    driver = ClothDriver(person(), [garment()], QUICK)
    return [driver.step(params(frame), 1 / FPS) for frame in frames]


def apart(one: ClothShape, other: ClothShape) -> float:
    """The mean distance of what is wholly simulated, metres."""
    return float(np.linalg.norm(one.displacements - other.displacements, axis=1)[one.share == 1].mean())


def test_a_run_is_what_the_driver_says_after_its_pre_roll():
    made = motions()
    made.simulate(range(30, 36))
    expected = stepped(range(18, 36))[-6:]
    for frame, shape in zip(range(30, 36), expected, strict=True):
        np.testing.assert_array_equal(made.shape(frame).displacements, shape.displacements)
        assert made.time(frame) == pytest.approx(frame / FPS)
    with pytest.raises(KeyError):
        made.shape(29)  # the pre-roll is nobody's business


def test_frames_are_simulated_once_and_in_any_order_of_asking():
    made = motions()
    made.simulate([33, 31, 32])
    first = made.shape(32)
    made.simulate([32, 31])
    assert made.shape(32) is first
    made.simulate([31, 34])  # 34 alone is new, and has its own pre-roll
    np.testing.assert_array_equal(made.shape(34).displacements, stepped(range(22, 35))[-1].displacements)
    made.simulate([])


def test_frames_that_nobody_knows_the_pose_of_are_passed_over():
    def some(frame: int) -> BodyParams | None:
        return None if frame in (27, 28, 31) else pose(frame)

    made = motions(some)
    made.simulate([30, 31, 32])
    assert apart(made.shape(32), stepped(range(18, 33))[-1]) < 0.004
    with pytest.raises(KeyError):
        made.shape(31)


def test_a_long_gap_is_said_and_the_rest_goes_on():
    made = motions(lambda frame: None if 10 < frame < 40 else pose(frame), pre_roll=1.0)
    with pytest.warns(GeometryWarning, match="simulated clothes: .*restart"):
        made.simulate([50])
    assert np.isfinite(made.shape(50).displacements).all()


def test_skinned_clothes_have_no_displacement_where_they_would_be_simulated():
    made = motions(mode="skin")
    made.simulate([3, 4])
    np.testing.assert_array_equal(made.shape(3).share, garment().share())
    assert not made.shape(3).displacements.any()


def test_few_frames_a_second_give_about_the_same_motion():
    made, slow = motions(), motions(lambda frame: pose(6 * frame), count=10, fps=FPS / 6)
    made.simulate(range(60))
    slow.simulate(range(10))
    still = made.shape(0)
    off = [apart(slow.shape(k), made.shape(6 * k)) for k in range(10)]
    moved = [apart(still, made.shape(6 * k)) for k in range(10)]
    assert max(moved) > 0.015 and np.mean(off) < 0.35 * np.mean(moved), (off, moved)


@pytest.mark.long
def test_smoothing_takes_the_shaking_of_a_tracker_out_of_the_cloth():
    shakes = {}
    for smoothing in (0.0, 0.03):
        made = motions(shaken, smoothing=smoothing)
        made.simulate(range(20, 50))
        free = made.shape(20).vertices[made.shape(20).share == 1]
        places = [in_the_world(made.shape(frame), shaken(frame))[free] for frame in range(20, 50)]
        shakes[smoothing] = np.abs(np.diff(places, n=2, axis=0)).mean()
    assert shakes[0.03] < 0.5 * shakes[0.0]


def test_every_second_number_is_half_the_frames_a_second():
    config = ClothMotionConfig(smoothing=0.05, pre_roll=0.2, driver=QUICK)
    plain = motions(count=30, fps=30.0, params=lambda k: shaken(2 * k), smoothing=0.05)
    skipping = ClothMotions(person(), [garment()], params=shaken, frames=range(0, 60, 2), fps=60.0, config=config)
    plain.simulate([20])
    skipping.simulate([40])
    np.testing.assert_array_equal(skipping.shape(40).displacements, plain.shape(20).displacements)


@pytest.mark.long
def test_uneven_frames_give_about_the_same_motion():
    """Two frames of three, as a camera gives them that drops every third."""
    made = motions(smoothing=0.03)
    left = [frame for frame in range(60) if frame % 3 != 2]
    config = ClothMotionConfig(smoothing=0.03, pre_roll=0.2, driver=QUICK)
    uneven = ClothMotions(person(), [garment()], params=pose, frames=left, fps=FPS, config=config)
    made.simulate(range(58))
    uneven.simulate(left)
    off = [apart(uneven.shape(frame), made.shape(frame)) for frame in left[:-2]]
    moved = [apart(made.shape(0), made.shape(frame)) for frame in left[:-2]]
    assert max(moved) > 0.015 and np.mean(off) < 0.1 * np.mean(moved), (off, moved)


@pytest.mark.long
def test_uneven_frames_are_smoothed_by_their_times():
    """A tracker's shaking goes out of the cloth where frames are missing as where none are."""
    shakes = {}
    left = [frame for frame in range(60) if frame % 3 != 2]
    for smoothing in (0.0, 0.05):
        config = ClothMotionConfig(smoothing=smoothing, pre_roll=0.2, driver=QUICK)
        uneven = ClothMotions(person(), [garment()], params=shaken, frames=left, fps=FPS, config=config)
        uneven.simulate(left)
        free = uneven.shape(0).vertices[uneven.shape(0).share == 1]
        places = [in_the_world(uneven.shape(frame), shaken(frame))[free] for frame in left[8:-8]]
        shakes[smoothing] = np.abs(np.diff(places, n=2, axis=0)).mean()
    assert shakes[0.05] < 0.6 * shakes[0.0]


def test_frames_and_numbers_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="frames to simulate"):
        motions().simulate([59, 60])
    for fps in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="frames a second"):
            motions(fps=fps)
    for name in ("pre_roll", "smoothing"):
        with pytest.raises(InputError, match=name):
            ClothMotionConfig(**{name: -0.1})


class Told:
    """Takes the place of simulated clothes and remembers what was asked for."""

    def __init__(self) -> None:
        self.asked: list[list[int]] = []

    def simulate(self, run) -> None:
        self.asked.append(list(run))

    def shape(self, frame: int) -> ClothShape:
        it = np.flatnonzero(template().cloth_mask)
        moved = np.full((len(it), 3), 0.01 * frame, np.float32)
        return ClothShape(it, moved, np.ones(len(it), np.float32))

    def skinned(self) -> ClothShape:
        it = np.flatnonzero(template().cloth_mask)
        return ClothShape(it, np.zeros((len(it), 3), np.float32), np.full(len(it), 0.5, np.float32))

    def time(self, frame: int) -> float:
        return frame / 10.0


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return open_capture(write_dance(tmp_path_factory.mktemp("captures") / "dance"))


def test_a_sequence_simulates_what_training_does_not_see_and_nothing_else(capture):
    told = Told()
    sequence = AvatarSequence(capture, template(), cloth=told)
    for frame in sequence.train_frames:
        new = sequence.pose(frame)
        assert new.cloth is None and new.frame == frame
    assert told.asked == []
    for frame in NOVEL_POSES:
        new = sequence.pose(frame)
        assert new.frame is None and new.time == frame / 10.0
        np.testing.assert_allclose(new.cloth.displacements[template().cloth_mask].numpy(), 0.01 * frame)
    assert told.asked[0] == list(NOVEL_POSES)  # the whole run at once, in order
    plain = AvatarSequence(capture, template())
    assert plain.pose(NOVEL_POSES[0]).cloth is None
    assert plain.with_cloth(told).pose(NOVEL_POSES[0]).cloth is not None


def test_training_frames_as_new_ones_are_simulated_in_order_from_one_start(capture):
    told = Told()
    sequence = AvatarSequence(capture, template(), cloth=told)
    new = sequence.as_new_pose(2)
    assert new.frame is None and new.known == 0.0 and new.cloth is not None
    assert told.asked == [list(sequence.train_frames)]
    assert sequence.pose(2).cloth is None
    without = AvatarSequence(capture, template()).as_new_pose(2)
    assert without.frame is None and without.cloth is None


def test_training_frames_as_new_ones_take_clothes_as_they_were_seen(capture):
    told = Told()
    sequence = AvatarSequence(capture, template(), cloth=told)
    seen = torch.full((len(template().vertices), 3), 0.03)
    new = sequence.as_new_pose(2, seen=seen)
    assert new.frame is None and new.known == 0.0 and new.time == 0.2
    assert told.asked == []  # nothing is simulated for what was seen
    # Of a garment's vertices each moves by its share, everything else as the model has it.
    moved, cloth = sequence.rig.displaced(new, torch.zeros_like(seen)), template().cloth_mask
    np.testing.assert_allclose(moved[cloth].numpy(), 0.5 * 0.03, rtol=1e-6)
    assert not moved[~cloth].any()


def test_the_run_about_a_frame_ends_where_training_begins(capture):
    sequence = AvatarSequence(capture, template(), cloth=Told())
    runs = [sequence._run_of(frame) for frame in NOVEL_POSES]
    assert runs == [list(NOVEL_POSES)] * 2
    assert all(b - a == 1 for a, b in pairwise(runs[0])) and len(dance()) == NOVEL_POSES[-1] + 1


def test_a_run_starts_from_what_was_seen_before_it_and_looks_at_nothing_later():
    """The truth moves with another drag; what is seen of it before the run brings the run nearer."""
    other = with_values(garment(), drag=12.0, pin_depth=garment().config.pin_depth)
    driver, places, truth = ClothDriver(person(), [other], QUICK), {}, {}
    for frame in range(60):
        truth[frame] = driver.step(pose(frame), 1 / FPS)
        places[frame] = driver.particles(PART)
    asked = []

    def seen(frame: int) -> dict[str, np.ndarray]:
        asked.append(frame)
        return {PART: places[frame]}

    cold, drawn = motions(), motions(seen=seen)
    for made in (cold, drawn):
        made.simulate(range(30, 36))
    assert asked == list(range(18, 30))
    wrong = [np.mean([apart(made.shape(frame), truth[frame]) for frame in range(30, 36)]) for made in (cold, drawn)]
    assert wrong[1] < 0.6 * wrong[0]
    unseen = motions(seen=lambda frame: {})
    unseen.simulate(range(30, 36))
    np.testing.assert_array_equal(unseen.shape(35).displacements, cold.shape(35).displacements)
