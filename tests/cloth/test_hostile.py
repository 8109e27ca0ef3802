"""Hostile values: each is refused with what is wrong, or said; the cloth stays finite, and the motion goes on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar.data.cloth_motion import ClothMotionConfig, ClothMotions
from smplxpp.cloth import ClothDriver, GarmentConfig, cut_garment
from smplxpp.core import BodyParams, InputError
from tests.cloth.persons import PART, person, standing
from tests.cloth.test_driver import QUICK, driver, garment

VALUES = (np.nan, np.inf, -np.inf, 1e9, -1e30, 1e300, 1e-300)


def hostile(name: str, value: float, *, whole: bool) -> BodyParams:
    """A pose with one number, or all of them, of a block replaced; InputError where no pose may have it."""
    params = standing()
    block = np.array(getattr(params, name))
    block.ravel()[: block.size if whole else 1] = value
    return replace(params, **{name: block})


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("name", ["global_orient", "body_pose", "transl"])
def test_poses_of_hostile_numbers_are_refused_or_followed_and_the_next_ones_are_good(name, value, whole):
    one = driver()
    one.step(standing(), 0.0)
    with np.errstate(all="ignore"):
        try:
            shape = one.step(hostile(name, value, whole=whole), 1 / 30)
        except InputError:
            assert not np.isfinite(value) or abs(value) > 1e6
        else:
            assert np.isfinite(value) and np.isfinite(shape.displacements).all()
    after = one.step(standing(), 1 / 30)
    assert np.isfinite(after.displacements).all() and np.isfinite(one.particles(PART)).all()
    assert np.linalg.norm(after.displacements, axis=1).max() < 2.0


@pytest.mark.parametrize("seconds", [0.0, -1.0, np.nan, np.inf, 1e-300, 1e300])
def test_hostile_steps_of_time_are_refused_or_followed(seconds):
    one = driver()
    one.step(standing(), 0.0)
    try:
        shape = one.step(standing(lifted=0.01), seconds)
    except InputError:
        assert not seconds > 0 or not np.isfinite(seconds)
    else:
        assert np.isfinite(shape.displacements).all()
    assert np.isfinite(one.step(standing(), 1 / 30).displacements).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_particles_put_anywhere_come_back_to_the_body_and_that_is_said(value):
    one = driver()
    one.step(standing(), 0.0)
    particles = one.particles(PART)
    particles[~garment().pinned] = value
    one.place(PART, particles)
    with np.errstate(all="ignore"):
        shape = one.step(standing(), 1 / 30)
    assert np.isfinite(shape.displacements).all()
    assert any("broke down" in said for said in one.notes)


@pytest.mark.parametrize("jump", [0.05, 0.5, 5.0, 500.0])
def test_motions_that_shake_wildly_keep_the_cloth_finite(jump):
    rng, one = np.random.default_rng(7), driver()
    for _ in range(8):
        at = tuple(jump * rng.normal(size=3))
        shape = one.step(standing(at=at, turned=float(rng.normal()), lifted=float(rng.uniform(0, 1))), 1 / 30)
        assert np.isfinite(shape.displacements).all()
        assert np.linalg.norm(shape.displacements, axis=1).max() < 3.0
    assert any("restart" in note for note in one.notes) == (jump >= 0.5)  # 12 m a second are a leap


def test_frames_of_hostile_numbers_of_a_motion_are_passed_over():
    def some(frame: int) -> BodyParams | None:
        """A capture gives no pose where its file has none, or one that is no pose."""
        try:
            return hostile("transl", np.nan, whole=True) if frame in (4, 5) else standing(lifted=0.02 * frame)
        except InputError:
            return None

    made = ClothMotions(
        person(), [garment()], params=some, frames=range(12), fps=30.0, config=ClothMotionConfig(driver=QUICK)
    )
    made.simulate([10, 11])
    assert np.isfinite(made.shape(11).displacements).all()


@pytest.mark.filterwarnings("ignore::smplxpp.core.errors.GeometryWarning")
@pytest.mark.parametrize("damage", [{"torn": True}, {"outwards": False}])
def test_torn_and_inside_out_garments_are_simulated(damage):
    template = person(**damage)
    one = ClothDriver(template, [cut_garment(template, PART, standing(), GarmentConfig(spacing=0.06))], QUICK)
    for lifted in (0.0, 0.1, 0.2, 0.1):
        shape = one.step(standing(lifted=lifted), 1 / 30)
        assert np.isfinite(shape.displacements).all()
        assert np.linalg.norm(shape.displacements, axis=1).max() < 0.6
    assert not any("broke down" in said for said in one.notes)


def test_a_garment_without_a_pinned_particle_falls_and_breaks_nothing():
    """No cut makes one, a file may say so: depths that are infinite all over."""
    one = ClothDriver(person(), [replace(garment(), depth=np.full(len(garment().particles), np.inf))], QUICK)
    for lifted in (0.0, 0.1, 0.2):
        assert np.isfinite(one.step(standing(lifted=lifted), 1 / 30).displacements).all()
