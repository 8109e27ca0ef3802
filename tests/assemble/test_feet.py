"""Feet give way to shoes: no toes come through the front, and the joints stay where they were."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.assemble.body_inside import feet_in_shoes
from smplxpp.body import load_body
from smplxpp.core import SkinWeights, TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.transfer import shoe_weights

BODY = load_body()
NAMES = list(BODY.joint_names)
JOINTS = BODY.joint_regressor @ BODY.v_template


@pytest.fixture(scope="module")
def short_shoe() -> TriangleMesh:
    """The left foot's own surface below the ankle, a tenth shorter, open where the foot comes in."""
    own = BODY.weights[:, [NAMES.index("left_ankle"), NAMES.index("left_foot")]].sum(axis=1) > 0.9
    shoe, _ = BODY.mesh().submesh(own[BODY.faces].all(axis=1))
    ankle = JOINTS[NAMES.index("left_ankle")]
    return shoe.with_vertices(ankle + (shoe.vertices - ankle) * [1.05, 1.0, 0.9])


def _bound(shoe: TriangleMesh, toes: float) -> SkinWeights:
    """Weights of a shoe that makes a share of the toes' turn."""
    dense = np.zeros((shoe.vertex_count, BODY.joint_count))
    dense[:, NAMES.index("left_ankle")], dense[:, NAMES.index("left_foot")] = 1.0 - toes, toes
    return SkinWeights.from_dense(dense)


def test_toes_that_came_through_the_front_of_a_shoe_are_drawn_into_it(short_shoe):
    field = SignedDistanceField(short_shoe, solid=False)
    ahead = short_shoe.vertices[:, 2].max()
    assert BODY.v_template[:, 2].max() > ahead + 0.01
    moved, model = feet_in_shoes(BODY, BODY.v_template, [(short_shoe, _bound(short_shoe, 0.5))])
    left = (BODY.weights[:, NAMES.index("left_foot")] > 0.5) & (BODY.v_template[:, 0] > 0)
    assert moved[left, 2].max() < ahead
    found = field.query(moved[left])
    assert found.distance[~found.on_border].max() < -0.0015
    # Skin above the shoes, and the other foot, are as they were.
    same = BODY.v_template[:, 1] > JOINTS[NAMES.index("left_ankle"), 1] + 0.1
    np.testing.assert_array_equal(
        moved[same | (BODY.v_template[:, 0] < -0.02)], BODY.v_template[same | (BODY.v_template[:, 0] < -0.02)]
    )
    # The toes in the shoe make half of their turn, as it does, and those of the bare foot all of it.
    at = [NAMES.index(f"{side}_foot") for side in ("left", "right")]
    np.testing.assert_allclose(model.weights[:, at], BODY.weights[:, at] * [0.5, 1.0])
    np.testing.assert_allclose(model.weights.sum(axis=1), 1.0)
    # All joints come from the moved vertices where they came from the others.
    np.testing.assert_allclose(model.joint_regressor @ moved, JOINTS, atol=1e-9)
    np.testing.assert_allclose(model.joint_regressor.sum(axis=1), BODY.joint_regressor.sum(axis=1), atol=1e-9)


def test_a_foot_inside_its_shoe_stays(short_shoe):
    ankle = JOINTS[NAMES.index("left_ankle")]
    wide = short_shoe.with_vertices(ankle + (short_shoe.vertices - ankle) * [1.25, 1.3, 1.56])
    moved, _ = feet_in_shoes(BODY, BODY.v_template, [(wide, _bound(wide, 1.0))])
    # But for skin between the toes, which is in front of the shoe's copy of them.
    change = np.linalg.norm(moved - BODY.v_template, axis=1)
    assert (change > 0).sum() < 60 and change.max() < 0.004
    bare, model = feet_in_shoes(BODY, BODY.v_template, [])
    assert bare is BODY.v_template and model is BODY


def test_a_high_heel_follows_the_ankle_alone_and_bends_with_no_toe():
    """A stiletto hung between heel and toes, took weights from both, and bent like rubber."""
    ankle, toes = JOINTS[NAMES.index("left_ankle")], JOINTS[NAMES.index("left_foot")]
    ball = toes - ankle
    heel = ankle + np.array([[0.0, -0.07, -0.04], [0.0, -0.14, -0.05], [0.0, -0.14, 0.01]])
    tip = toes + 0.05 * ball / np.linalg.norm(ball)
    shaft = ankle + [0.0, 0.12, 0.0]
    points = np.concatenate([heel, tip[None], shaft[None]])
    # As transferred: everything bends with everything.
    given = np.zeros((5, BODY.joint_count))
    given[:, [NAMES.index(f"left_{joint}") for joint in ("knee", "ankle", "foot")]] = [0.2, 0.4, 0.4]
    mesh = TriangleMesh(points, np.array([[0, 1, 2], [2, 3, 4]]))
    stiff = shoe_weights(SkinWeights.from_dense(given), mesh, JOINTS, joint_names=BODY.joint_names).dense()
    np.testing.assert_allclose(stiff[:3, NAMES.index("left_ankle")], 1.0)
    assert stiff[3, NAMES.index("left_foot")] == pytest.approx(0.5)
    assert stiff[3, NAMES.index("left_ankle")] == pytest.approx(0.5)
    np.testing.assert_allclose(stiff[4], given[4])
