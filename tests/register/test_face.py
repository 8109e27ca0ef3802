"""Points of the face: they open the jaw and move the expression, and nothing else does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core import Camera, Keypoints2D
from smplxpp.register import Observations, RegisterConfig, register
from smplxpp.register.landmarks import LandmarkModel
from tests.register.people import moving, ring

BODY = load_body()
FACE = tuple(f"face_{k}" for k in range(17, 68))
NAMES = (*BODY.joint_names[:22], *FACE)


@pytest.fixture(scope="module")
def smiling():
    person = moving(BODY, 1)
    expression = np.zeros((1, BODY.num_expressions))
    for name, value in (("mouthSmileLeft", 0.7), ("mouthSmileRight", 0.7), ("browInnerUp", 0.6)):
        expression[0, BODY.expression_names.index(name)] = value
    return replace(person, expression=expression, jaw_pose=np.array([[0.2, 0.0, 0.0]]))


@pytest.fixture(scope="module")
def cameras(smiling):
    """Two cameras close to the face beside those around the person."""
    head = BODY.forward(smiling).joints[0, BODY.joint_names.index("head")]
    out = ring(4)
    for k, angle in enumerate((-0.4, 0.4)):
        eye = head + np.array([0.8 * np.sin(angle), 0.05, 0.8 * np.cos(angle)])
        one = Camera.look_at(eye=eye, target=head, fov_y_deg=28.0, width=480, height=480)
        out[f"Face{k}"] = replace(one, name=f"Face{k}")
    return out


def seen(params, cameras, names):
    landmarks = LandmarkModel.of(BODY, names)
    posed = BODY.forward(params).frame(0)
    points = landmarks.points(posed.vertices, posed.joints)
    return {
        name: Keypoints2D(
            landmarks.names, np.array([0]), camera.screen_from_world(points)[None, :, :2], np.ones((1, len(points)))
        )
        for name, camera in cameras.items()
    }


def away_mm(found, true):
    """Mean distance of the face's landmarks."""
    landmarks = LandmarkModel.of(BODY, FACE)
    points = [landmarks.points(p.vertices, p.joints) for p in (BODY.forward(x).frame(0) for x in (found, true))]
    return 1e3 * np.linalg.norm(points[0] - points[1], axis=1).mean()


def test_points_of_the_face_find_jaw_and_expression(smiling, cameras):
    with_face = register(BODY, Observations((0,), cameras, keypoints=seen(smiling, cameras, NAMES)), RegisterConfig())
    without = register(
        BODY, Observations((0,), cameras, keypoints=seen(smiling, cameras, BODY.joint_names[:22])), RegisterConfig()
    )
    assert not without.params.expression.any() and not without.params.jaw_pose.any()
    assert away_mm(with_face.params, smiling) < 0.4 * away_mm(without.params, smiling)
    assert away_mm(with_face.params, smiling) < 1.5
    smile = BODY.expression_names.index("mouthSmileLeft")
    assert with_face.params.expression[0, smile] > 0.2
    assert with_face.params.jaw_pose[0, 0] > 0.05
