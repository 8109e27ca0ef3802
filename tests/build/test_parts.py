"""Which legs that a scan fused are cut apart."""

from __future__ import annotations

import numpy as np

from smplxpp.assemble.fill_holes import LEG_CUT
from smplxpp.build.parts import _long_stretches, cut_check, torn_specks
from smplxpp.clean import BridgeConfig
from smplxpp.core import TriangleMesh, concatenate_meshes


def strip(height: float, *, at: float) -> TriangleMesh:
    """A strip from leg to leg, 4 cm wide, in steps of a centimetre down."""
    count = round(100 * height) + 1
    y, x = np.meshgrid(np.linspace(0.7, 0.7 - height, count), [at, at + 0.04], indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    first = 2 * np.arange(count - 1)[:, None]
    return TriangleMesh(vertices, np.concatenate([first + [0, 2, 1], first + [1, 2, 3]]))


def test_legs_are_parted_where_they_are_fused_for_long_alone():
    """Shorts that were fused below the crotch were cut; the patch across the cut tore 21-fold in a high step."""
    short, long = strip(0.5 * LEG_CUT, at=0.0), strip(1.5 * LEG_CUT, at=1.0)
    both = concatenate_meshes([short, long])
    parted = _long_stretches(both, np.ones(both.face_count, dtype=bool))
    assert not parted[: short.face_count].any() and parted[short.face_count :].all()
    # What is not joined stays so, and no joined face is no error.
    assert not _long_stretches(both, np.zeros(both.face_count, dtype=bool)).any()
    half = np.arange(both.face_count) % 2 == 0
    assert not (_long_stretches(both, half) & ~half).any()


def test_sleeves_that_hung_against_the_trunk_are_named():
    """A real man before eleven cameras, his arms at his sides: a third of his shirt was cut, and nothing told why."""
    fused, apart = cut_check("upper", 0.302), cut_check("upper", 0.103)
    assert (fused.status, apart.status) == ("warn", "pass") and "arms and legs held apart" in fused.explanation
    assert cut_check("upper", 1.0).status == "warn"


def test_a_corner_that_is_torn_to_the_hand_is_cut_and_a_skirt_that_stretches_is_not():
    """Of a real man's shirt, its sleeves against his trunk, 13 faces of the hem were sails of 0.16 m2 in the T-pose."""
    part = strip(10.0, at=0.0)
    count = part.vertex_count
    for moved, torn in ((np.arange(count) == count - 1, 1), (np.arange(count) >= count // 2, 0)):
        # The last corner is carried off; or all of the lower half is drawn apart.
        away = np.where(moved, 0.5 * (1 + np.arange(count) - np.argmax(moved)), 0.0)
        rest = part.with_vertices(part.vertices + away[:, None] * [0.0, -1.0, 0.0])
        assert torn_specks(part, rest, BridgeConfig()).sum() == torn
    assert not torn_specks(part, part, BridgeConfig()).any()
