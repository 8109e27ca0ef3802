"""Motions that are known whole, as clothes follow them in films: smoothed, even at slow rates, cut at leaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.cloth.play import SLOWEST, followed, play, ways
from smplxpp.core import BodyParams, InputError
from tests.cloth.persons import person
from tests.cloth.test_driver import QUICK, garment, swaying


def swung(fps: float, seconds: float) -> BodyParams:
    return BodyParams.concatenate([swaying(k / fps) for k in range(round(seconds * fps) + 1)])


@pytest.mark.parametrize("fps", [3.0, 5.0, 30.0, 120.0])
def test_there_are_enough_poses_and_those_given_are_among_them(fps):
    motion = swung(fps, 2.0)
    poses, times = followed(motion, fps, smoothing=0.0)
    assert times * fps >= SLOWEST - 1e-6 and (times - 1) * fps < SLOWEST
    np.testing.assert_allclose(poses.transl[::times], motion.transl, atol=1e-12)
    found = list(ways(motion, fps, smoothing=0.0))
    assert [len(way) for way in found] == [1] + [times] * (len(motion) - 1)
    np.testing.assert_allclose([way[-1].transl[0] for way in found], motion.transl, atol=1e-12)


def test_nothing_is_smoothed_over_a_leap():
    motion = swung(30.0, 1.0)
    leapt = replace(motion, transl=motion.transl + np.where(np.arange(31) < 12, 0.0, 1.0)[:, None] * [1.0, 0.0, 0.0])
    found = list(ways(leapt, 30.0))
    assert [k for k, way in enumerate(found) if len(way) == 1] == [0, 12]
    for k in (11, 12):
        np.testing.assert_allclose(found[k][-1].transl, leapt.transl[[k]], atol=1e-12)
    with pytest.raises(InputError, match="frames a second"):
        next(ways(leapt, 0.0))


def last(motion: BodyParams, fps: float, **options) -> np.ndarray:
    *_, surface = play(person(), [garment()], motion, fps=fps, config=QUICK, **options)
    return surface[garment().vertices]


@pytest.mark.long
def test_three_frames_a_second_swing_as_thirty_do():
    """Every one of them began anew, and said so: a third of a second was a gap."""
    notes: list[str] = []
    slow = last(swung(3.0, 3.0), 3.0, notes=notes)
    assert notes == []
    fine, skinned = last(swung(30.0, 3.0), 30.0), person().pose(swaying(3.0))[0][garment().vertices]
    assert np.linalg.norm(slow - fine, axis=1).mean() < 0.5 * np.linalg.norm(skinned - fine, axis=1).mean()


@pytest.mark.long
def test_a_shaken_motion_shakes_clothes_less():
    rng = np.random.default_rng(0)
    motion = swung(30.0, 1.0)
    shaken = replace(motion, transl=motion.transl + 0.006 * rng.standard_normal(motion.transl.shape))
    free = garment().vertex_depth > 0.15

    def trembles(**options) -> float:
        """Of what hangs free beside the drawn body: second differences, metres."""
        surfaces = list(play(person(), [garment()], shaken, fps=30.0, config=QUICK, **options))
        places = np.stack([surface[garment().vertices][free] for surface in surfaces[5:]])
        return float(np.linalg.norm(np.diff(places, 2, axis=0), axis=2).mean())

    assert trembles() < 0.8 * trembles(smoothing=0.0)
