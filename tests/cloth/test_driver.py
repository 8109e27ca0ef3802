"""The driver: starts, cuts, gaps, broken simulations, and that nothing but the motion decides what the cloth does."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from smplxpp.cloth import ClothDriver, ClothShape, DriverConfig, Garment, GarmentConfig, cut_garment
from smplxpp.cloth.play import play
from smplxpp.cloth.solver import ClothSolver
from smplxpp.core import BodyParams, InputError, matrix_from_rotvec
from tests.cloth.persons import PART, person, standing

QUICK = DriverConfig(ramp=0.2, hold=0.1)


@cache
def garment() -> Garment:
    """The skirt, coarse."""
    return cut_garment(person(), PART, standing(), GarmentConfig(spacing=0.06, collider_spacing=0.04))


def driver(config: DriverConfig = QUICK) -> ClothDriver:
    return ClothDriver(person(), [garment()], config)


def swaying(t: float) -> BodyParams:
    """A pose of a motion that begins without a jerk."""
    return standing(at=(0.15 * np.sin(2 * np.pi * 0.5 * t) ** 2, 0.0, 0.0), lifted=0.5 * np.sin(np.pi * 0.5 * t) ** 2)


def followed(fps: float, seconds: float = 1.0) -> ClothDriver:
    """A driver that has followed the swaying."""
    one = driver()
    for k in range(round(seconds * fps) + 1):
        one.step(swaying(k / fps), 1.0 / fps)
    return one


def skinned() -> np.ndarray:
    """The particles where skinning has them."""
    return person().vertices[garment().particles]


def test_a_cold_start_ends_where_cloth_hangs():
    one = driver(DriverConfig())
    shape = one.step(standing(at=(0.4, 0.0, 0.2), turned=0.5), 0.0)
    still = one.particles(PART)
    for _ in range(10):
        one.step(standing(at=(0.4, 0.0, 0.2), turned=0.5), 1 / 30)
    assert one.notes == []
    assert np.abs(one.particles(PART) - still).max() < 0.05
    assert np.abs(one.particles(PART) - still).mean() < 0.01
    np.testing.assert_array_equal(shape.vertices, garment().vertices)
    assert shape.displacements[shape.share > 0].any()


def in_the_world(shape: ClothShape, params: BodyParams) -> np.ndarray:
    """The person's vertices in a pose, the cloth displaced."""
    template = person()
    posed = template.posed_body(params)
    moved = template.vertices.copy()
    moved[shape.vertices] += shape.displacements
    blended = np.einsum("vj,jab->vab", template.weights.dense(), posed.posed_from_rest[0])
    return np.einsum("vij,vj->vi", blended[:, :3, :3], moved) + blended[:, :3, 3]


def test_cloth_over_another_pose_hangs_where_it_hung():
    one = followed(30.0)
    shape = one.step(swaying(1.0), 1 / 30)
    shaken = standing(at=(0.02, -0.01, 0.01), turned=0.03, lifted=0.55)
    over = one.over(shaken)
    there, here = in_the_world(shape, swaying(1.0)), in_the_world(over, shaken)
    np.testing.assert_allclose(here[over.vertices], there[over.vertices], atol=2e-5)
    np.testing.assert_array_equal(over.share, shape.share)
    np.testing.assert_array_equal(one.over(swaying(1.0)).displacements, shape.displacements)


def test_displacements_put_the_cloth_where_the_particles_are():
    one = followed(30.0)
    world = in_the_world(one.step(swaying(1.0), 1 / 30), swaying(1.0))
    # Those that stand for particles; skin may push them out by a few millimetres.
    np.testing.assert_allclose(world[garment().particles], one.particles(PART), atol=0.015)
    assert np.abs(world[garment().particles] - one.particles(PART)).mean() < 0.002


def test_pinned_particles_are_on_the_body_and_the_others_lag():
    one = driver()
    for k in range(16):
        one.step(standing(at=(0.8 * (k / 15) ** 2, 0.0, 0.0)), 1 / 30)
    there, pinned = skinned() + [0.8, 0.0, 0.0], garment().pinned
    np.testing.assert_allclose(one.particles(PART)[pinned], there[pinned], atol=1e-5)
    hem = garment().depth > 0.4
    assert (one.particles(PART)[hem, 0] - there[hem, 0]).mean() < -0.03


def test_the_same_motion_gives_the_same_bits():
    np.testing.assert_array_equal(followed(30.0).particles(PART), followed(30.0).particles(PART))


def test_a_person_who_stands_and_looks_elsewhere_has_the_same_cloth():
    shapes = []
    for turned, at in ((0.0, (0.0, 0.0, 0.0)), (1.2, (0.5, 0.3, -0.2))):
        one, turn = driver(), matrix_from_rotvec(np.array([0.0, turned, 0.0]))
        for k in range(12):
            swayed = turn @ [0.1 * np.sin(k / 5) ** 2, 0.0, 0.0]
            shape = one.step(standing(at=tuple(swayed + at), turned=turned), 1 / 30)
        shapes.append(shape.displacements)
    assert np.abs(shapes[0]).max() > 0.03
    # Folds are chaotic: rounding grows by ten in a tenth of a second.
    assert np.linalg.norm(shapes[1] - shapes[0], axis=1).mean() < 0.0015


def test_far_from_the_origin_cloth_does_the_same():
    shapes, ends = [], []
    for away in (0.0, 100.0):
        one = driver()
        for k in range(40):
            at = (away + 0.15 * np.sin(k / 6) ** 2, 0.0, 0.4 * away)
            shape = one.step(standing(at=at, lifted=0.5 * np.sin(k / 10) ** 2), 1 / 30)
        shapes.append(shape.displacements)
        ends.append(one.particles(PART) - np.float32([away, 0.0, 0.4 * away]))
    assert np.abs(shapes[0]).max() > 0.03
    np.testing.assert_allclose(shapes[1], shapes[0], atol=1e-3)
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-3)


def test_a_long_way_is_followed_without_a_jerk():
    """What places are measured from moves along, and the cloth does not notice."""
    walk, still = driver(), driver()
    for k in range(50):
        way = 0.2 * np.maximum(k - 10, k**2 / 40 if k < 20 else 0)  # 6 m a second after two thirds of one
        shapes = [one.step(standing(at=at), 1 / 30) for one, at in ((walk, (way, 0.0, 0.0)), (still, (0, 0, 0)))]
    assert walk.notes == []
    place = walk.particles(PART) - np.float32([way, 0.0, 0.0])
    pinned = garment().pinned
    np.testing.assert_allclose(place[pinned], skinned()[pinned], atol=1e-4)
    # At 6 m/s the skirt lies back against the legs.
    assert place[garment().depth > 0.3, 0].mean() < still.particles(PART)[garment().depth > 0.3, 0].mean() - 0.05
    assert np.isfinite(shapes[0].displacements).all()


def test_frames_a_second_hardly_matter():
    ends = {fps: followed(fps).particles(PART) for fps in (5.0, 30.0, 120.0)}
    there = skinned() + [0.15 * np.sin(np.pi) ** 2, 0, 0]
    assert np.linalg.norm(ends[120.0] - there, axis=1).mean() > 0.02  # it moved
    apart = {fps: np.linalg.norm(ends[fps] - ends[120.0], axis=1) for fps in (5.0, 30.0)}
    assert apart[30.0].mean() < 0.015 and apart[5.0].mean() < 0.025


@pytest.mark.parametrize(
    ("at", "seconds", "why"), [((3.0, 0.0, 0.0), 1 / 30, "leap"), ((0.1, 0.0, 0.0), 0.5, "without a pose")]
)
def test_a_leap_and_a_gap_start_anew_and_say_so(at, seconds, why):
    one = followed(30.0, 0.3)
    assert one.notes == []
    shape = one.step(standing(at=at), seconds)
    assert len(one.notes) == 1 and why in one.notes[0] and "restart" in one.notes[0]
    fresh = driver()
    np.testing.assert_array_equal(shape.displacements, fresh.step(standing(at=at), 0.0).displacements)
    # From there on as well.
    again = [one.step(standing(at=(at[0] + 0.02, 0.0, 0.0)), 1 / 30) for one in (one, fresh)]
    np.testing.assert_array_equal(again[0].displacements, again[1].displacements)


def test_restart_forgets():
    one = followed(30.0, 0.3)
    one.restart()
    np.testing.assert_array_equal(
        one.step(standing(), 1 / 30).displacements, driver().step(standing(), 0.0).displacements
    )
    assert one.notes == []


def test_a_pose_that_is_not_known_holds_the_cloth_and_is_said():
    one = followed(30.0, 0.3)
    before = one.particles(PART)
    held = one.step(None, 1 / 30)
    assert "no pose" in one.notes[0]
    np.testing.assert_array_equal(one.particles(PART), before)
    assert np.isfinite(held.displacements).all()
    one.step(swaying(0.3 + 2 / 30), 2 / 30)  # seconds since the last step that had one
    assert len(one.notes) == 1
    assert np.abs(one.particles(PART) - followed(30.0, 0.3 + 2 / 30).particles(PART)).mean() < 0.005


def test_motion_may_begin_with_unknown_poses():
    one = driver()
    for _ in range(3):
        shape = one.step(None, 1 / 30)
    assert not shape.displacements.any() and len(one.notes) == 3
    assert one.step(standing(), 1 / 30).displacements.any()


def test_a_simulation_that_breaks_falls_back_to_the_body_and_says_so():
    one = driver(replace(QUICK, most_stretch=0.01))
    shape = one.step(standing(), 0.0)
    assert one.notes and all("broke down" in sentence and PART in sentence for sentence in one.notes)
    np.testing.assert_allclose(one.particles(PART), skinned(), atol=1e-5)
    moving = shape.share > 0
    assert np.linalg.norm(shape.displacements[moving], axis=1).mean() < 0.004  # a coarse mesh carries it


def test_a_body_that_starts_in_collision_is_said_and_comes_out():
    lifted = standing(lifted=1.0)
    one = driver(DriverConfig(ramp=0.0, hold=0.0))
    one.step(lifted, 0.0)
    assert any("start inside the body" in sentence for sentence in one.notes)
    count = len(one.notes)
    for _ in range(30):
        shape = one.step(lifted, 1 / 30)
    assert not any("broke down" in sentence for sentence in one.notes[count:])
    assert np.isfinite(shape.displacements).all()


def test_surfaces_along_a_motion_are_those_of_the_steps():
    motion = BodyParams.concatenate([swaying(k / 30) for k in range(4)])
    template, one, notes = person(), driver(), []
    for k, surface in enumerate(play(template, [garment()], motion, fps=30.0, config=QUICK, notes=notes)):
        shape = one.step(motion.frame(k), 1 / 30)
        plain = template.pose(motion.frame(k))[0]
        others = np.setdiff1d(np.arange(template.vertex_count), shape.vertices)
        np.testing.assert_allclose(surface[others], plain[others], atol=1e-6)
        at_pins = shape.vertices[shape.share == 0]
        np.testing.assert_allclose(surface[at_pins], plain[at_pins], atol=1e-6)
    moving = garment().particles[garment().depth > 0.1]
    assert np.abs(surface[moving] - one.particles(PART)[garment().depth > 0.1]).mean() < 0.003
    assert notes == []


def test_what_is_not_asked_for_rightly_is_refused():
    template = person()
    with pytest.raises(InputError, match="at least one garment"):
        ClothDriver(template, [])
    with pytest.raises(InputError, match="cut from this template"):
        ClothDriver(template, [replace(garment(), part="cape")])
    with pytest.raises(InputError, match="cut from this template"):
        ClothDriver(template, [replace(garment(), vertices=garment().vertices + template.vertex_count)])
    one = driver()
    with pytest.raises(InputError, match="simulated part"):
        one.particles("cape")
    with pytest.raises(InputError, match="one frame"):
        one.step(BodyParams.concatenate([standing(), standing()]), 1 / 30)
    one.step(standing(), 0.0)
    for seconds in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="seconds"):
            one.step(standing(), seconds)
    for name, value in (("ramp", -0.1), ("hold", float("nan")), ("teleport", 0.0), ("most_stretch", -1.0)):
        with pytest.raises(InputError, match=name):
            DriverConfig(**{name: value})


def test_cloth_that_is_drawn_over_another_pose_is_measured_once_there():
    """Each frame was carried and measured for the pose that leads there, and then again for the one that is drawn."""
    path, drawn = [swaying(t) for t in (0.3, 0.35)], swaying(0.36)
    one, other = followed(30.0, 0.3), followed(30.0, 0.3)
    shape, before = one.follow(path, 1 / 30, drawn), other.quality[0].frames
    for pose in path:
        other.step(pose, 1 / 60)
    np.testing.assert_array_equal(shape.displacements, other.over(drawn).displacements)
    assert one.quality[0].frames == before + 2 < other.quality[0].frames


def test_contacts_that_a_ramp_lets_go_are_not_counted(monkeypatch):
    """Of an open coat's 214 in a squat 79 were of arms that came down before the first frame."""
    advance = ClothSolver.advance

    def pinched(self, *args):
        advance(self, *args)
        self._report[0] += 3

    monkeypatch.setattr(ClothSolver, "advance", pinched)
    one = driver()
    one.step(standing(), 0.0)
    assert one.quality[0].released == 0
    one.step(standing(lifted=0.1), 1 / 30)
    assert one.quality[0].released == 3


@pytest.mark.parametrize("up", [0.0, 7.0])
def test_a_skirt_that_reaches_the_ground_comes_to_rest_on_it(up):
    """Hems of who kneels, falls or lies sank through the ground; 7 m up the places are measured from elsewhere."""
    ground = 0.6 + up
    one, free = driver(replace(QUICK, floor=ground)), driver()
    for k in range(12):
        for each in (one, free):
            each.step(standing(at=(0.02 * k, up, 0.0)), 1 / 30)
    lowest, sunk = one.particles(PART)[:, 1].min(), free.particles(PART)[:, 1].min()
    assert sunk < ground - 0.1 < ground < lowest + 1e-5 < ground + 0.01
    drawn = one._threads[0].carried() + one._origin
    assert drawn[:, 1].min() >= ground - 1e-5
    (found,) = one.quality
    assert found.holds and found.longest <= 1.2 + 1e-3, "to be lifted makes no edge longer"


def test_the_ground_stops_what_falls_and_slows_what_slides():
    """Coulomb: mu = 0.15 times the speed of the fall is taken from that along the ground, down to none."""
    one = driver(replace(QUICK, floor=0.0))
    one.step(standing(), 0.0)
    thread = one._threads[0]
    position, velocity = thread._state.position, thread._state.velocity
    position[:4] = [[0, -0.3, 0], [0, -0.3, 0], [0, -0.3, 0], [0, 0.3, 0]]
    velocity[:4] = [[3, -2, 4], [0.1, -2, 0], [3, 1, 0], [3, -2, 4]]
    thread._lay_on(0.1)
    np.testing.assert_allclose(position[:4, 1], [0.1, 0.1, 0.1, 0.3])
    slid = (5.0 - 0.15 * 2.0) / 5.0
    np.testing.assert_allclose(velocity[:4], [[3 * slid, 0, 4 * slid], [0, 0, 0], [3, 1, 0], [3, -2, 4]], rtol=1e-6)


def test_cloth_is_drawn_towards_where_it_was_seen_and_takes_up_its_motion():
    one, placed = followed(30.0), followed(30.0)
    before, loose = one.particles(PART), ~garment().pinned
    seen = before + np.float32([0.02, 0.0, 0.01])
    seen[0] = np.nan  # not seen: what its neighbours do
    one.draw_to(PART, seen, 1 / 30, gain=0.5)
    drawn = one.particles(PART) - before
    np.testing.assert_allclose(drawn[loose], np.tile([0.01, 0.0, 0.005], (loose.sum(), 1)), atol=1e-6)
    assert not drawn[~loose].any()  # what the body holds stays on it
    placed.place(PART, one.particles(PART))
    for each in (one, placed):
        each.step(swaying(1.0 + 1 / 30), 1 / 30)
    on = (one.particles(PART) - placed.particles(PART))[loose].mean(axis=0)
    assert on[0] > 0.002 and on[2] > 0.001  # it goes on that way, which a place alone does not tell


def test_the_more_is_believed_the_nearer_is_cloth_to_what_was_seen_and_nothing_is_nothing():
    before = followed(30.0).particles(PART)
    rng = np.random.default_rng(0)
    seen = before + rng.normal(scale=0.01, size=before.shape) + [0.0, 0.0, 0.03]
    left = []
    for gain in (0.0, 0.5, 1.0):
        one = followed(30.0)
        one.draw_to(PART, seen, 1 / 30, gain=gain)
        left.append(np.linalg.norm((one.particles(PART) - seen)[~garment().pinned], axis=1).mean())
    assert left[0] > left[1] > left[2] > 0.001  # noise from particle to particle is not followed
    one = followed(30.0)
    one.draw_to(PART, np.full(before.shape, np.nan), 1 / 30)
    np.testing.assert_array_equal(one.particles(PART), before)


def test_what_was_seen_of_nobody_is_refused():
    one = followed(30.0)
    with pytest.raises(InputError, match="simulated part"):
        one.draw_to("cape", one.particles(PART), 0.1)
    with pytest.raises(InputError, match="shape"):
        one.draw_to(PART, one.particles(PART)[1:], 0.1)
    with pytest.raises(InputError, match="seconds"):
        one.draw_to(PART, one.particles(PART), 0.0)
    with pytest.raises(InputError, match="gain"):
        one.draw_to(PART, one.particles(PART), 0.1, gain=1.5)
