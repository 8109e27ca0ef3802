"""The rig poses as the template does, and its gradients are those of skinning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from threadpoolctl import ThreadpoolController

from avatar.rig.rig import Rig
from smplxpp.core import InputError, matrix_from_rotvec, rotvec_from_matrix
from tests.dolls.dancing import FRAMES, dance, template
from tests.export.templates import open_body_template, random_motion, random_template

RANDOM = random_template(joint_count=55, pose_correctives=True)
MOTION = random_motion(3, expressions=3)


@pytest.mark.parametrize("frame", range(FRAMES))
def test_pose_is_the_templates(frame):
    rig = Rig(template())
    posed = rig.skin(rig.pose(dance().frame(frame)))
    np.testing.assert_allclose(posed.numpy(), template().pose(dance().frame(frame))[0], atol=1e-6)


@pytest.mark.parametrize("frame", range(3))
def test_expression_and_pose_correctives_are_in_it(frame):
    rig, params = Rig(RANDOM), MOTION.frame(frame)
    pose = rig.pose(params)
    np.testing.assert_allclose(rig.skin(pose).numpy(), RANDOM.pose(params)[0], atol=2e-5)
    assert np.abs(pose.rest.numpy() - RANDOM.vertices).max() > 1e-3


def test_the_open_body_with_parameters_of_fewer_expressions():
    body = open_body_template()
    rig = Rig(body)
    params = random_motion(1, expressions=4)
    pose = rig.pose(params)
    assert pose.expression.shape == (rig.expression_size,) and rig.expression_size > 4
    np.testing.assert_array_equal(pose.expression[:4].numpy(), params.expression[0].astype(np.float32))
    assert not pose.expression[4:].any()
    np.testing.assert_allclose(rig.skin(pose).numpy(), body.pose(params)[0], atol=1e-5)


def test_displacements_move_with_their_vertices_and_gradients_are_the_skinnings():
    rig = Rig(RANDOM)
    pose = rig.pose(MOTION.frame(1))
    random = torch.Generator().manual_seed(0)
    moved = 0.1 * torch.randn(RANDOM.vertex_count, 3, generator=random)
    weight = torch.randn(RANDOM.vertex_count, 3, generator=random)
    displacements = moved.clone().requires_grad_()
    (rig.skin(pose, displacements) * weight).sum().backward()
    A = pose.world_from_rest[..., :3]
    # In float64, as numpy multiplies matrices.
    linear = A.double().numpy()
    expected = rig.skin(pose).numpy() + np.einsum("vij,vj->vi", linear, moved.double().numpy())
    np.testing.assert_allclose(rig.skin(pose, moved).numpy(), expected, atol=1e-5)
    np.testing.assert_allclose(
        displacements.grad.numpy(), np.einsum("vij,vi->vj", linear, weight.double().numpy()), atol=1e-5
    )


def test_root_from_world_takes_the_roots_motion_away():
    rig, params = Rig(RANDOM), MOTION.frame(2)
    turn = matrix_from_rotvec(np.array([0.3, -1.1, 0.4]))
    turned = rotvec_from_matrix(turn @ matrix_from_rotvec(params.global_orient[0]))
    other = replace(params, global_orient=turned[None], transl=params.transl + [[1.0, 2.0, 3.0]])
    local = []
    for each in (params, other):
        pose = rig.pose(each)
        to_root = pose.root_from_world
        local.append(rig.skin(pose) @ to_root[:3, :3].T + to_root[:3, 3])
    np.testing.assert_allclose(local[0].numpy(), local[1].numpy(), atol=2e-5)


def test_the_null_code_changes_the_frame_alone():
    pose = Rig(template()).pose(dance().frame(2), frame=2)
    null = pose.without_code()
    assert (pose.frame, null.frame) == (2, None)
    assert replace(null, frame=2).body_pose is pose.body_pose and null.rest is pose.rest


def test_blas_works_on_one_thread_and_has_the_others_back(monkeypatch):
    def threads() -> set[int]:
        return {pool["num_threads"] for pool in ThreadpoolController().info() if pool["user_api"] == "blas"}

    it, within, before = template(), [], threads()
    posed_body = type(it).posed_body
    monkeypatch.setattr(type(it), "posed_body", lambda *given: within.append(threads()) or posed_body(*given))
    Rig(it).pose(dance().frame(0))
    assert within == [{1}] and threads() == before


def test_several_frames_are_refused():
    with pytest.raises(InputError, match="one frame"):
        Rig(template()).pose(dance())


def test_semantic_colours_and_cloth_are_the_templates():
    rig = Rig(template())
    np.testing.assert_array_equal(rig.cloth_mask.numpy(), template().cloth_mask)
    assert rig.semantic_colors[-1].tolist() == [1.0, 0.0, 0.0]  # clothes are red to a trainer
