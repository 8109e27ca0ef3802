"""What drives a pose that training did not see: the null code where training showed it, else the first frame's."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.model_file import load_avatar, save_avatar
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.student import Student, StudentConfig
from avatar.training.engine.session import Session
from avatar.training.student.bake import BakeConfig, BakeTask, bake
from avatar.training.student.compensate import frame_rate
from tests.dolls.dancing import gaussians, sequence, write_dance
from tests.dolls.tiny import TINY_FIELD

CONFIG = BakeConfig(
    iterations=3, lr=1e-2, code_lr_factor=10.0, weights=ReconstructionWeights(perceptual=0.0), evaluations=1
)
SHAPES = BlendShapeConfig(expression_size=2, head_shapes=2, body_shapes=3, width=8)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    return sequence(write_dance(tmp_path_factory.mktemp("captures") / "dance"))


def trained(frames, folder, null_share: float) -> Student:
    """A student after a few steps, whose codes are moved far enough from each other to be told apart."""
    student, _ = bake(
        frames,
        gaussians(),
        StudentConfig(field=TINY_FIELD),
        replace(CONFIG, null_share=null_share),
        Session(folder),
        teacher=None,
    )
    with torch.no_grad():
        student.codes.codes.add_(torch.arange(1.0, len(student.frames) + 1)[:, None])
        for value in student.field.parameters():
            value.add_(0.01)
    return student


def displaced(student: Student, frames, code: torch.Tensor) -> torch.Tensor:
    """The field's displacements of a pose, driven by a code."""
    return student.field(frames.pose(2).body_pose[None], code[None])[0]


@pytest.mark.parametrize("null_share", [0.0, 0.5])
def test_a_new_pose_is_driven_by_a_code_that_training_showed(frames, tmp_path, null_share):
    student = trained(frames, tmp_path / "bake", null_share)
    new = frames.pose(2).without_code()
    with torch.no_grad():
        first = displaced(student, frames, student.codes.codes[0])
        zero = displaced(student, frames, torch.zeros(TINY_FIELD.code_size))
        assert (first - zero).abs().max() > 1e-5
        expected = first if null_share == 0.0 else zero
        torch.testing.assert_close(student.displacements(new), expected)
        torch.testing.assert_close(student.with_blend_shapes(SHAPES).displacements(new), expected)
        save_avatar(tmp_path / "student.safetensors", student)
        stored = load_avatar(tmp_path / "student.safetensors", frames.rig)
        torch.testing.assert_close(stored.displacements(new), expected)


def test_the_null_code_that_training_shows_is_the_zero_vector(frames):
    """Also while the codes are learned: a step that shows it moves no code."""
    student = Student(StudentConfig(field=TINY_FIELD), frames.rig, gaussians(), frames.train_frames)
    task = BakeTask(frames, student, replace(CONFIG, null_share=1.0))
    with torch.no_grad():
        student.codes.codes.add_(1.0)
    task.step(0)
    assert student.codes.codes.grad is None or not student.codes.codes.grad.any()


@pytest.mark.parametrize(("frames", "fps"), [((0, 2, 4, 8), 10.0), ((3,), 20.0)])
def test_the_rate_of_the_training_frames_is_that_of_the_capture_over_their_step(frames, fps):
    capture = SimpleNamespace(fps=20.0)
    assert frame_rate(SimpleNamespace(capture=capture, train_frames=frames)) == fps
    assert frame_rate(SimpleNamespace(capture=SimpleNamespace(fps=None), train_frames=frames)) is None
