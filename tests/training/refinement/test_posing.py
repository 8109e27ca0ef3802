"""From small turns to posed vertices and back: against the body model, float64 autograd and a rigid motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.posing import PosedTemplate, RigiditySkinning, rigidity
from avatar.training.refinement.variables import BODY_JOINTS, Variables
from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.register import BodyState
from smplxpp.skinning.linear_blend import skin
from tests.dolls.gesturing import disturbed, gestures, template

CONFIG = RefineConfig()
TURN = matrix_from_rotvec(np.array([0.0, 0.2, 0.0]))


def posed_template(rigid: np.ndarray | None = None) -> PosedTemplate:
    it = template()
    return PosedTemplate(it, np.ones(it.vertex_count) if rigid is None else rigid)


def state() -> BodyState:
    params = disturbed(gestures(), degrees=20.0)
    of_body = BodyState.of_params(template().body, params)
    return replace(of_body, expression=np.random.default_rng(1).normal(size=of_body.expression.shape))


def test_vertices_are_the_templates():
    frame = state()
    params = frame.to_params(template().body)
    for row in (0, 3):
        placed = posed_template().place(frame, row)
        expected = template().pose(params.frame(row))[0]
        np.testing.assert_allclose(placed.vertices.detach().numpy(), expected, atol=2e-6)


def test_gradients_of_skinning_are_those_of_float64_autograd():
    random = torch.Generator().manual_seed(0)
    V, J = 40, 5
    rest, transforms = torch.randn(V, 3, generator=random), torch.randn(J, 3, 4, generator=random)
    weights = torch.softmax(3.0 * torch.randn(V, J, generator=random), dim=1)
    pull = torch.randn(V, 3, generator=random)
    ours = rest.clone().requires_grad_(), transforms.clone().requires_grad_()
    RigiditySkinning.apply(*ours, weights, torch.ones(V)).backward(pull)
    slow = rest.double().requires_grad_(), transforms.double().requires_grad_()
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(J, 1, 4)
    skin(slow[0], weights.double(), torch.cat([slow[1], last], dim=1)).backward(pull.double())
    for own, reference in zip(ours, slow, strict=True):
        torch.testing.assert_close(own.grad.double(), reference.grad, rtol=1e-4, atol=1e-4)


def test_gradients_of_steps_are_finite_differences():
    posed, frame, row = posed_template(), state(), 2
    names = template().body.joint_names
    random = np.random.default_rng(0)
    pull = random.normal(size=(template().vertex_count, 3))
    gradient = posed.gradient(posed.place(frame, row), torch.tensor(pull, dtype=torch.float32))

    def value(turns: np.ndarray, transl: np.ndarray, expression: np.ndarray) -> float:
        rotations = frame.rotations.copy()
        rotations[row] = matrix_from_rotvec(turns) @ rotations[row]
        moved = BodyState(rotations, frame.transl + transl, frame.betas, frame.expression + expression)
        return float((template().pose(moved.to_params(template().body).frame(row))[0] * pull).sum())

    zero = np.zeros((len(names), 3)), np.zeros(3), np.zeros(2)
    step = 1e-5
    for part, index in (
        (0, (0, 1)),
        (0, (names.index("head"), 2)),
        (0, (names.index("spine3"), 0)),
        (1, (2,)),
        (2, (0,)),
    ):
        ahead, behind = ([array.copy() for array in zero] for _ in range(2))
        ahead[part][index], behind[part][index] = step, -step
        numeric = (value(*ahead) - value(*behind)) / (2.0 * step)
        np.testing.assert_allclose(gradient[part][index], numeric, rtol=2e-3, atol=1e-3)


def test_steps_of_variables_are_the_turns_that_gradients_speak_of():
    it = template()
    variables = Variables.of_body(it.body.joint_count, 2, CONFIG)
    frame = state()
    steps = np.zeros((len(frame), len(variables)))
    steps[:, variables.transl] = [0.0, 0.1, 0.0]
    steps[1, 1] = 0.2
    moved = variables.stepped(frame, steps)
    np.testing.assert_allclose(moved.transl - frame.transl, np.tile([0.0, 0.1, 0.0], (len(frame), 1)))
    np.testing.assert_allclose(
        moved.rotations[1, 0], matrix_from_rotvec(np.array([0.0, 0.2, 0.0])) @ frame.rotations[1, 0]
    )
    np.testing.assert_array_equal(moved.rotations[0], frame.rotations[0])
    assert list(variables.joints[:BODY_JOINTS]) == list(range(BODY_JOINTS))


def test_loose_cloth_has_no_gradient_on_the_pose():
    it = template()
    rigid = rigidity(it, 0.01)
    loose = rigid == 0.0
    assert (rigid[~it.cloth_mask] == 1.0).all() and loose[it.cloth_mask].mean() > 0.5
    posed, frame = posed_template(rigid), state()
    pull = torch.randn(it.vertex_count, 3, generator=torch.Generator().manual_seed(0))
    only_cloth = pull * torch.tensor(loose)[:, None]
    for part in posed.gradient(posed.place(frame, 0), only_cloth):
        assert not part.any()
    with_cloth = posed.gradient(posed.place(frame, 0), pull)
    without = posed.gradient(posed.place(frame, 0), pull - only_cloth)
    for one, other in zip(with_cloth, without, strict=True):
        np.testing.assert_array_equal(one, other)
