"""Levels of detail move, speak and close as the template that they are made of."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import pytest

from smplxpp.body import stress_poses
from smplxpp.build.detail import covered_faces, simplified_template
from smplxpp.core import BodyParams, InputError
from smplxpp.core.topology import border_loops
from smplxpp.template.template import Template
from tests.export.templates import open_body_template, with_part


@pytest.fixture(scope="module")
def shirted() -> Template:
    """The open body in a shirt 8 mm off its trunk and upper arms."""
    body = open_body_template()
    names = body.body.joint_names
    trunk = [names.index(f"{s}_{n}") for s in ("left", "right") for n in ("collar", "shoulder")]
    trunk += [names.index(n) for n in ("spine1", "spine2", "spine3")]
    held = body.weights.dense()[:, trunk].sum(axis=1) > 0.6
    body = replace(body, body=replace(body.body, posedirs=None))
    return with_part(body, "upper", 3, body.faces[held[body.faces].all(axis=1)], 0.008)


@pytest.fixture(scope="module")
def level(shirted, tmp_path_factory) -> Template:
    path = tmp_path_factory.mktemp("level") / "a.npz"
    return Template.load(shirted.export(path, faces=6000))


def test_a_level_has_the_faces_asked_for_and_the_joints_of_its_source(shirted, level):
    assert 0.95 * 6000 < len(level.faces) < 1.02 * 6000 and level.part_names == shirted.part_names
    np.testing.assert_allclose(level.weights.joint_weights.sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(level.joints, shirted.joints, atol=1e-9)
    # Jaw and eyes follow expressions, and all joints the floor.
    rng = np.random.default_rng(0)
    faces = replace(BodyParams.rest(betas=0, expressions=52), expression=rng.uniform(0, 1, (1, 52)))
    np.testing.assert_allclose(*[t.body.forward(faces).rest_joints for t in (level, shirted)], atol=1e-9)
    lift = level.on_floor().joints - level.joints
    assert np.ptp(lift, axis=0).max() < 1e-6 and lift[0, 1] > 0.5


def test_it_moves_and_speaks_as_its_source(shirted, level):
    """Lips that exchanged their expressions would be two centimetres off, fingers that exchanged weights more."""
    spoken = np.zeros((1, 52))
    for name in ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "mouthSmileLeft"):
        spoken[0, shirted.body.expression_names.index(name)] = 0.7
    poses = stress_poses(BodyParams.rest(betas=0, expressions=52))
    poses = replace(poses, expression=np.repeat(spoken, len(poses), axis=0), flat_hand_mean=True)
    ours, theirs = level.pose(poses), shirted.pose(poses)
    for name in level.part_names:
        used, faces = np.unique(level.faces[level.part_faces(name)]), shirted.faces[shirted.part_faces(name)]
        for k in range(len(poses)):
            distance = np.sqrt(igl.point_mesh_squared_distance(ours[k][used], theirs[k], faces)[0])
            assert np.percentile(distance, 99) < 0.004 and distance.max() < 0.012, (name, k)


def test_borders_of_clothes_stay_where_they_meet_the_skin(shirted, level):
    before, after = (t.part_mesh("upper") for t in (shirted, level))
    rims = [mesh.vertices[np.concatenate(border_loops(mesh.faces))] for mesh in (before, after)]
    assert {tuple(p) for p in rims[0].round(9)} <= {tuple(p) for p in rims[1].round(9)}


def test_skin_under_cloth_is_left_out_and_what_shows_stays(shirted, level):
    covered = covered_faces(shirted)
    names = list(shirted.body.joint_names)
    strongest = shirted.weights.dense().argmax(axis=1)[shirted.faces[:, 0]]
    assert covered[strongest == names.index("spine2")].mean() > 0.25
    for name in ("head", "jaw", "left_index2", "right_knee", "left_elbow"):
        assert not covered[strongest == names.index(name)].any()
    # The margin beside the rims of the shirt is there.
    shirt = shirted.part_mesh("upper")
    rim = shirt.vertices[np.concatenate(border_loops(shirt.faces))]
    centers = shirted.mesh.triangles.mean(axis=1)[covered]
    assert min(np.linalg.norm(rim - center, axis=1).min() for center in centers) > 0.01
    assert not covered[shirted.part_faces("upper")].any() and not covered_faces(open_body_template()).any()
    np.testing.assert_allclose(level.mesh.bbox_diagonal, shirted.mesh.bbox_diagonal, rtol=0.01)


def test_numbers_that_make_no_sense_are_refused_and_enough_changes_nothing(shirted, tmp_path):
    assert simplified_template(shirted, 10**6) is shirted
    with pytest.raises(InputError, match="at least 1000, received 10"):
        shirted.export(tmp_path / "a.glb", faces=10)
    assert list(tmp_path.iterdir()) == []
