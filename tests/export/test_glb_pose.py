"""The skinning of a written GLB gives the template's poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body.named_poses import stress_poses
from smplxpp.core import BodyParams, GeometryWarning, InputError, SkinWeights
from smplxpp.export import write_glb
from tests.export.glb_reader import GlbReader
from tests.export.templates import open_body_template, random_motion, random_template

PARTS = ("body", "upper", "shoes")


def _posed_parts(template, reader: GlbReader, frame: int | None) -> np.ndarray:
    return np.concatenate([reader.posed(name, frame=frame) for name in PARTS])


@pytest.mark.parametrize("joint_count", [24, 52, 55])
def test_every_keyframe_is_the_templates_pose(tmp_path, joint_count):
    template = random_template(joint_count=joint_count)
    motion = random_motion(4, expressions=3)
    write_glb(tmp_path / "a.glb", template, animation=motion)
    reader, expected = GlbReader(tmp_path / "a.glb"), template.pose(motion)
    for frame in range(4):
        found = _posed_parts(template, reader, frame)
        np.testing.assert_allclose(found, expected[frame, : len(found)], atol=5e-6)


def test_at_rest_the_skin_leaves_the_t_pose(tmp_path):
    template = random_template(joint_count=3)  # any skeleton, without an animation
    write_glb(tmp_path / "a.glb", template)
    found = _posed_parts(template, GlbReader(tmp_path / "a.glb"), None)
    np.testing.assert_allclose(found, template.vertices[: len(found)], atol=1e-6)


def test_open_body_in_hard_poses_with_a_face(tmp_path):
    template = open_body_template()
    poses = stress_poses(BodyParams.rest(betas=10, expressions=52)).select([0, 3])
    motion = replace(poses, expression=np.random.default_rng(1).uniform(0, 1, (2, 52)))
    write_glb(tmp_path / "a.glb", template, animation=motion)
    reader, expected = GlbReader(tmp_path / "a.glb"), template.pose(motion)
    for frame in range(2):
        # Micrometres: float32, and moves below 1e-6 m a unit left out of 52 targets.
        np.testing.assert_allclose(reader.posed("body", frame=frame), expected[frame], atol=5e-6)


def test_joints_that_an_expression_moves_are_translated(tmp_path):
    template = random_template()
    motion = random_motion(3, expressions=3)
    write_glb(tmp_path / "face.glb", template, animation=motion)
    write_glb(tmp_path / "neutral.glb", template, animation=motion, morph_targets=False)
    still = replace(motion, expression=np.zeros((3, 3)))
    for frame in range(3):
        found = _posed_parts(template, GlbReader(tmp_path / "neutral.glb"), frame)
        np.testing.assert_allclose(found, template.pose(still)[frame, : len(found)], atol=5e-6)
    assert _translated(GlbReader(tmp_path / "face.glb")) > 1
    assert _translated(GlbReader(tmp_path / "neutral.glb")) == 1


def _translated(reader: GlbReader) -> int:
    return sum(c["target"]["path"] == "translation" for c in reader.json["animations"][0]["channels"])


def test_neighbouring_keyframes_turn_the_short_way(tmp_path):
    template = random_template()
    # A pelvis that turns twice about: quaternions of matrices alone would jump in sign.
    turn = np.zeros((50, 55, 3))
    turn[:, 0, 1] = np.linspace(0, 4 * np.pi, 50)
    motion = BodyParams.from_full_pose(turn, betas=np.zeros(2), expression=np.zeros(3), transl=np.zeros(3), fps=25.0)
    write_glb(tmp_path / "a.glb", template, animation=motion)
    reader = GlbReader(tmp_path / "a.glb")
    (animation,) = reader.json["animations"]
    node = next(k for k, n in enumerate(reader.json["nodes"]) if n["name"] == "joint0")
    channel = next(c for c in animation["channels"] if c["target"] == {"node": node, "path": "rotation"})
    sampler = animation["samplers"][channel["sampler"]]
    quaternions = reader.array(sampler["output"])
    assert ((quaternions[1:] * quaternions[:-1]).sum(axis=1) > 0.9).all()
    np.testing.assert_allclose(reader.array(sampler["input"])[:, 0], np.arange(50) / 25, rtol=1e-6)


def test_frame_rate_defaults_to_thirty(tmp_path):
    write_glb(tmp_path / "a.glb", random_template(), animation=random_motion(4, expressions=0))
    reader = GlbReader(tmp_path / "a.glb")
    accessor = reader.json["accessors"][reader.json["animations"][0]["samplers"][0]["input"]]
    assert accessor["min"] == [0.0]
    assert accessor["max"] == pytest.approx([3 / 30])


def test_ninth_influence_is_dropped_and_rows_renormalised(tmp_path):
    template = random_template(influences=24)
    kept = SkinWeights.from_dense(template.weights.dense(), max_influences=8)
    motion = random_motion(1, expressions=3)
    write_glb(tmp_path / "a.glb", template, animation=motion)
    found = _posed_parts(template, GlbReader(tmp_path / "a.glb"), 0)
    np.testing.assert_allclose(found, replace(template, weights=kept).pose(motion)[0, : len(found)], atol=5e-6)


def test_pose_correctives_are_left_out_with_a_warning(tmp_path):
    template = random_template(pose_correctives=True)
    motion = random_motion(2, expressions=3)
    with pytest.warns(GeometryWarning, match="pose correctives"):
        write_glb(tmp_path / "a.glb", template, animation=motion)
    found = _posed_parts(template, GlbReader(tmp_path / "a.glb"), 1)
    np.testing.assert_allclose(
        found, replace(template, body=replace(template.body, posedirs=None)).pose(motion)[1, : len(found)], atol=5e-6
    )


@pytest.mark.parametrize(
    ("joint_count", "motion", "match"),
    [
        (24, random_motion(2, expressions=4), "parameter expression"),
        (7, random_motion(2, expressions=3), "24, 52, 55 joints"),
        (24, random_motion(2, expressions=3, fps=0.0), "fps"),
        (24, random_motion(2, expressions=3, fps=float("nan")), "fps"),
        (24, random_motion(2, expressions=3).select([]), "at least one frame"),
        (55, replace(random_motion(2, expressions=3), left_hand_pose=np.zeros((2, 6))), "left_hand_pose"),
    ],
)
def test_motion_that_the_template_cannot_play_is_refused(tmp_path, joint_count, motion, match):
    path = tmp_path / "a.glb"
    path.write_bytes(b"kept")
    with pytest.raises(InputError, match=match):
        write_glb(path, random_template(joint_count=joint_count), animation=motion)
    assert path.read_bytes() == b"kept"
    assert list(tmp_path.iterdir()) == [path]
