"""Gaussians in a mouth that stays shut, or on clothes that no view shows, learn nothing; all others do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.learned_gaussians import LEARNED, LearnedGaussians
from avatar.models.networks.blend_shapes import BlendShapeConfig, BlendShapes
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from avatar.training.engine import unseen as module
from avatar.training.engine.unseen import color_clothed_skin, hold_colors, hold_unseen, unseen
from smplxpp.body import load_body
from smplxpp.core.params import BodyParams
from smplxpp.template.mouth import inside_of_mouth
from tests.dolls import dancing
from tests.dolls.dancing import template as doll
from tests.dolls.doll import place_camera
from tests.template.test_template import template_of


class Posing:
    """Frames of a sequence, as far as it is asked what they show."""

    def __init__(
        self, rig: Rig, poses: list[BodyParams], angles: tuple[float, ...] = (0.0, 90.0, 180.0, 270.0)
    ) -> None:
        self.rig, self.train_frames, self._poses = rig, tuple(range(len(poses))), poses
        self._cameras = {
            str(angle): place_camera(str(angle), angle, size=(96, 128), height=0.7, target=0.45) for angle in angles
        }
        self.train_cameras = tuple(self._cameras)

    def pose(self, frame: int):
        return self.rig.pose(self._poses[frame])

    def camera(self, name: str):
        return self._cameras[name]


def at_rest(rig: Rig) -> BodyParams:
    body = rig.template.body
    return BodyParams.rest(betas=body.num_betas, expressions=body.num_expressions)


def talking(rig: Rig, *jaws: float) -> Posing:
    """With the jaw turned so far in each frame."""
    return Posing(rig, [replace(at_rest(rig), jaw_pose=np.array([[jaw, 0.0, 0.0]])) for jaw in jaws])


@pytest.fixture(scope="module")
def rig():
    return Rig(template_of(load_body(num_betas=4, num_expressions=6), np.zeros(4)))


@pytest.fixture(scope="module")
def bound(rig):
    return sample_on_mesh(rig.template, SamplingConfig(count=12_000, head_share=0.6, hidden_density=1.0))


def test_only_the_mouth_and_only_while_it_is_shut(rig, bound):
    gaussians = LearnedGaussians(bound)
    corners = rig.template.faces[bound.face_index.numpy()]
    inside, body = inside_of_mouth(rig.template)[corners].all(axis=1), rig.template.vertex_part[corners[:, 0]] == 0
    shut, opened = (unseen(talking(rig, *jaws), gaussians).numpy() & body for jaws in ((0.0, 0.0), (0.0, 0.4)))
    assert inside.sum() > 50 and not (shut & ~inside).any()
    assert shut.sum() > 0.5 * inside.sum()
    assert opened.sum() < 0.7 * shut.sum() and not (opened & ~shut).any()


def dressed(turns: tuple[float, ...], angles: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Which Gaussians of the doll nothing shows, and how far each is to the front, metres.

    Args:
        turns: of the doll in each frame about the vertical, radians. angles: of the cameras, degrees.
    """
    rig = Rig(doll())
    gaussians = sample_on_mesh(rig.template, SamplingConfig(count=3000))
    poses = [replace(at_rest(rig), global_orient=np.array([[0.0, turn, 0.0]])) for turn in turns]
    corners = rig.template.vertices[rig.template.faces[gaussians.face_index.numpy()]]
    return unseen(Posing(rig, poses, angles), LearnedGaussians(gaussians)).numpy(), corners[..., 2].mean(axis=1)


def test_clothes_that_no_view_shows_and_no_skin():
    hidden, front = dressed((0.0,), (0.0,))
    assert hidden.sum() > 300 and front[hidden].max() < 0.0  # the dress behind, to one camera ahead
    rig = Rig(doll())
    faces = sample_on_mesh(rig.template, SamplingConfig(count=3000)).face_index.numpy()
    assert (rig.template.vertex_part[rig.template.faces[faces[hidden]]] == 1).all()


@pytest.mark.parametrize(("turns", "angles"), [((0.0,), (0.0, 180.0)), ((0.0, np.pi), (0.0,))])
def test_another_camera_or_another_pose_shows_them(turns, angles):
    hidden, _ = dressed(turns, angles)
    assert hidden.mean() < 0.01


def test_what_is_held_gets_no_gradient(rig, bound):
    gaussians = LearnedGaussians(bound)
    shapes = BlendShapes(BlendShapeConfig(), len(bound), active=torch.arange(0, len(bound), 2))
    sequence = talking(rig, 0.0)
    held = unseen(sequence, gaussians)
    hold_unseen(sequence, gaussians, shapes)
    learned = [getattr(gaussians, name) for name in LEARNED]
    sum(value.square().sum() + value.sum() for value in (*learned, shapes.U, shapes.C)).backward()
    for value in learned:
        moves = value.grad.flatten(1).abs().amax(dim=1) if value.ndim > 1 else value.grad.abs()
        assert not moves[held].any() and moves[~held].any()
    for basis in (shapes.U, shapes.C):
        moves = basis.grad.flatten(1).abs().amax(dim=1)
        assert not moves[held[shapes.active]].any() and moves[~held[shapes.active]].all()


def test_skin_under_clothes_takes_the_colour_of_bare_skin_and_keeps_it(tmp_path):
    """In a player that takes clothes off the body wore their smear; places, sizes and the clothes learn on."""
    sequence = dancing.sequence(dancing.write_dance(tmp_path / "dance"))
    bound = dancing.gaussians(600)
    corners = bound.face_index.numpy()
    template = sequence.rig.template
    skin = template.vertex_part[template.faces[corners][:, 0]] == 0
    height = template.vertices[template.faces[corners]][..., 1].mean(axis=1)
    # Trained colours: a white head, and the smear of the dress on the torso.
    colors = np.where(skin & (height > 0.6), 0.9, 0.1)[:, None].repeat(3, axis=1)
    student = Student(StudentConfig(field=None), sequence.rig, replace(bound, dc=torch.tensor(colors).float()), ())
    held = color_clothed_skin(sequence, student).numpy()
    assert held[skin & (height < 0.45)].mean() > 0.8 and not held[~skin].any() and not held[height > 0.7].any()
    assert np.median(student.gaussians.dc.detach().numpy()[held & (height < 0.45)]) > 0.6, (
        "of the head, not of the smear"
    )
    np.testing.assert_array_equal(student.gaussians.dc.detach().numpy()[~held], colors[~held].astype(np.float32))
    hold_colors(student.gaussians, None, torch.tensor(held))
    sum(getattr(student.gaussians, name).sum() for name in ("dc", "sh", "offset")).backward()
    assert not student.gaussians.dc.grad[held].any() and student.gaussians.dc.grad[~held].all()
    assert not student.gaussians.sh.grad[held].any() and student.gaussians.offset.grad.all()


def test_sequences_of_the_same_frames_share_what_is_seen_and_others_do_not(rig, bound, monkeypatch):
    """Five stages of a training looked at the same mouth and clothes from all cameras, each by its own sequence."""
    looks: list[int] = []
    look = module._hidden_clothes
    monkeypatch.setattr(module, "_hidden_clothes", lambda *seen: looks.append(1) or look(*seen))
    gaussians = LearnedGaussians(bound)
    one, same, other = (unseen(talking(rig, *jaws), gaussians) for jaws in ((0.01, 0.02), (0.01, 0.02), (0.01, 0.4)))
    assert len(looks) == 2 and torch.equal(one, same) and not torch.equal(one, other)
