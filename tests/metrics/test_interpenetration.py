"""Volume that two closed surfaces share, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from smplxpp.core import InputError, TriangleMesh, matrix_from_rotvec
from smplxpp.metrics import interpenetration


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0)) -> TriangleMesh:
    made = trimesh.creation.box(size)
    return TriangleMesh(made.vertices + at, made.faces)


def ball(radius: float, at: tuple[float, float, float] = (0, 0, 0)) -> TriangleMesh:
    made = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return TriangleMesh(made.vertices + at, made.faces)


def test_boxes_share_a_box_in_cubic_centimetres():
    found = interpenetration(box((0.2, 0.2, 0.2)), box((0.1, 0.1, 0.1), at=(0.1, 0, 0)))
    assert found.volume_cm3 == pytest.approx(5 * 10 * 10)
    assert found.share == pytest.approx(0.5)
    assert (found.volume_a_cm3, found.volume_b_cm3) == pytest.approx((8000, 1000))


def test_balls_share_a_lens():
    r, apart = 0.1, 0.12
    lens = np.pi * (4 * r + apart) * (2 * r - apart) ** 2 / 12
    assert interpenetration(ball(r), ball(r, at=(apart, 0, 0))).volume_cm3 == pytest.approx(lens * 1e6, rel=0.01)


def test_it_is_the_same_both_ways_and_after_a_turn_and_nothing_apart():
    a, b = ball(0.1), box((0.15, 0.1, 0.3), at=(0.08, 0.02, 0))
    turn = matrix_from_rotvec(np.array([0.4, 1.0, -0.3]))
    first, back = interpenetration(a, b), interpenetration(b, a)
    moved = interpenetration(*(mesh.with_vertices(mesh.vertices @ turn.T + [1, 2, 3]) for mesh in (a, b)))
    assert first.volume_cm3 == pytest.approx(back.volume_cm3) == pytest.approx(moved.volume_cm3, rel=1e-6)
    assert interpenetration(ball(0.1), ball(0.1, at=(1, 0, 0))).volume_cm3 == 0


def test_open_surfaces_are_refused_with_what_to_do():
    whole = ball(0.1)
    sheet = whole.submesh(whole.face_centers[:, 1] > 0)[0]
    with pytest.raises(InputError, match=r"second surface.*border edges.*thickness"):
        interpenetration(whole, sheet)
