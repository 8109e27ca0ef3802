"""Faces in motions that training never showed: held to their surface, and unchanged in what it showed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.gaussians.binding import on_triangles, world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from avatar.training.student.unseen_motion import on_drawn_face, with_held_face
from smplxpp.core import BodyParams, Camera, TriangleMesh
from smplxpp.raster import rasterize_mesh
from smplxpp.template.mouth import inside_of_mouth
from tests.export.templates import open_body_template

SKIN, EYE = torch.tensor([0.8, 0.6, 0.5]), torch.tensor([0.1, 0.2, 0.3])


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig(open_body_template())


def labelled(rig: Rig, student: Student, name: str) -> torch.Tensor:
    """The Gaussians on a named part of the body."""
    template = rig.template
    on = template.body.part_labels == template.body.part_label_names.index(name)
    return torch.tensor(on[template.faces[student.gaussians.face_index.numpy()]].all(axis=1))


def student_of(rig: Rig) -> Student:
    """A student of skin and eyes in one colour each."""
    gaussians = sample_on_mesh(rig.template, SamplingConfig(count=9000, head_share=0.9, hidden_density=1.0))
    student = Student(StudentConfig(field=None), rig, gaussians, ())
    with torch.no_grad():
        student.gaussians.dc.copy_(SKIN.expand(len(gaussians), 3))
        for side in ("left", "right"):
            student.gaussians.dc[labelled(rig, student, f"{side}_eye")] = EYE
    return student


def strained(rig: Rig, *, blink: float = 0.0, jaw: float = 0.0) -> BodyParams:
    body = rig.template.body
    rest = BodyParams.rest(betas=body.num_betas, expressions=body.num_expressions)
    expression = np.zeros_like(rest.expression)
    for side in ("Left", "Right"):
        expression[0, body.expression_names.index(f"eyeBlink{side}")] = blink
    return replace(rest, expression=expression, jaw_pose=np.array([[jaw, 0.0, 0.0]]))


def means(student: Student, params: BodyParams) -> torch.Tensor:
    pose = student.rig.pose(params)
    frames = triangle_frames(student.rig.skin(pose), student.rig.faces)
    return world_from_frames(student.compensated(pose), frames).means


@torch.no_grad()
def test_lids_close_in_the_colour_of_skin_and_an_open_mouth_is_free_and_what_was_seen_does_not_change(rig):
    student = student_of(rig).with_blend_shapes(
        BlendShapeConfig(expression_size=rig.expression_size, head_shapes=2, body_shapes=3, width=8, jaw=True)
    )
    shapes = student.blend_shapes
    generator = torch.Generator().manual_seed(1)
    for value in (shapes.U, shapes.C):
        value.normal_(std=1e-4, generator=generator)
    # One of the lips is large enough to veil an open mouth.
    opened = strained(rig, jaw=0.3)
    inside = inside_of_mouth(rig.template)
    within = torch.tensor(inside[rig.template.faces[student.gaussians.face_index.numpy()]].all(axis=1))
    middle = means(student, opened)[within].mean(dim=0)
    at = means(student, opened)
    lips = torch.where(
        labelled(rig, student, "body") & ~within & (at[:, 2] > middle[2]), (at - middle).norm(dim=1), 9.0
    )
    lip = int(torch.argmin(lips))
    frames = triangle_frames(rig.vertices, rig.faces)
    student.gaussians.log_scales[lip] = torch.log(0.02 / frames.lengths[student.gaussians.face_index[lip]])
    blinks, jaws = torch.zeros(4, rig.expression_size), torch.zeros(4, 3)
    names = rig.template.body.expression_names
    blinks[:, [names.index("eyeBlinkLeft"), names.index("eyeBlinkRight")]] = torch.linspace(0.0, 0.2, 4)[:, None]
    jaws[:, 0] = torch.linspace(0.0, 0.1, 4)
    held = with_held_face(student, blinks, jaws)
    assert held.blend_shapes.config.head_shapes == 2 + 3
    for params in (strained(rig), strained(rig, blink=0.2, jaw=0.1)):
        before, after = (one.compensated(one.rig.pose(params)) for one in (student, held))
        torch.testing.assert_close(after.offset, before.offset, atol=1e-7, rtol=0)
        torch.testing.assert_close(after.dc, before.dc, atol=1e-6, rtol=0)
    # In a blink the eyes themselves have the skin's colour: a gap between lids shows skin.
    closed = held.compensated(held.rig.pose(strained(rig, blink=1.0)))
    for side in ("left", "right"):
        torch.testing.assert_close(closed.dc[labelled(rig, held, f"{side}_eye")].mean(dim=0), SKIN, atol=0.01, rtol=0)
    # The veil goes back into the head, and the inside has the template's colours; other skin stays.
    free = held.compensated(held.rig.pose(opened))
    own = student.compensated(student.rig.pose(opened))
    drawn = means(held, opened)
    assert (at[lip] - drawn[lip])[2] > 0.02
    colors = torch.tensor(rig.template.vertex_colors[rig.template.faces].mean(axis=1) / 255.0, dtype=torch.float32)
    # Of the inside what a view from ahead shows; the rest lies behind skin, through which it shines.
    mesh = TriangleMesh(rig.template.pose(opened)[0], rig.template.faces)
    camera = Camera.orthographic_view(
        center=middle.double().numpy(), direction=np.array([0.0, 0.0, 1.0]), half_extent=0.05, size=200
    )
    ids, pixels = rasterize_mesh(mesh, camera).face_id, camera.screen_from_world(at.double().numpy())[:, :2]
    column, row = np.clip(pixels.astype(int), 0, 199).T
    ahead = within & torch.tensor(inside[rig.template.faces[ids[row, column]]].any(axis=1) & (ids[row, column] >= 0))
    assert ahead.sum() > 5
    torch.testing.assert_close(free.dc[ahead], colors[held.gaussians.face_index[ahead]], atol=0.01, rtol=0)
    far = (at - middle).norm(dim=1) > 0.1
    torch.testing.assert_close(free.offset[far], own.offset[far], atol=1e-7, rtol=0)
    torch.testing.assert_close(free.dc[far], own.dc[far], atol=1e-6, rtol=0)


@torch.no_grad()
def test_motions_that_training_showed_get_no_shape(rig):
    student = student_of(rig).with_blend_shapes(
        BlendShapeConfig(expression_size=rig.expression_size, head_shapes=2, body_shapes=3, width=8, jaw=True)
    )
    assert with_held_face(student, torch.ones(2, rig.expression_size), torch.full((2, 3), 0.4)) is student


@torch.no_grad()
def test_gaussians_that_slid_off_their_faces_move_with_those_that_they_draw_and_rest_as_they_did(rig):
    """Gaussians that training had carried from the chin to the lips stayed on the chin when the mouth opened."""
    student = student_of(rig).with_blend_shapes(
        BlendShapeConfig(expression_size=rig.expression_size, head_shapes=2, body_shapes=3, width=8, jaw=True)
    )
    generator = torch.Generator().manual_seed(2)
    for value in (student.blend_shapes.U, student.blend_shapes.C, student.gaussians.sh):
        value.normal_(std=1e-4, generator=generator)
    # Every Gaussian slides by 6 mm along the surface, as far as many of a head do in a training.
    turn = 2.0 * torch.pi * torch.rand(len(student.gaussians), generator=generator)
    student.gaussians.offset.copy_(0.006 * torch.stack([torch.zeros_like(turn), turn.cos(), turn.sin()], dim=1))
    bound = on_drawn_face(student)
    rest, center = rig.pose(strained(rig)), torch.tensor([[0.0, 1.5, 2.0]])
    before, after = (one(rest, center) for one in (student, bound))
    torch.testing.assert_close(after.gaussians.means, before.gaussians.means, atol=1e-5, rtol=0)
    torch.testing.assert_close(after.gaussians.scales[:, 1:], before.gaussians.scales[:, 1:], atol=1e-6, rtol=1e-3)
    torch.testing.assert_close(after.gaussians.normals, before.gaussians.normals, atol=1e-3, rtol=0)
    torch.testing.assert_close(after.colors, before.colors, atol=1e-3, rtol=0)
    # A place of a face that a blink or a jaw moves takes what is drawn there along.
    for params in (strained(rig, blink=1.0), strained(rig, jaw=0.3)):
        moved = rig.skin(rig.pose(params)) - rig.vertices
        there = on_triangles(moved[rig.faces[bound.gaussians.face_index]], bound.gaussians.barycentric)
        off = [(means(one, params) - before.gaussians.means - there).norm(dim=1) for one in (student, bound)]
        of_motion = (student.gaussians.face_index != bound.gaussians.face_index) & (torch.maximum(*off) > 0.002)
        assert of_motion.sum() > 20
        assert off[1][of_motion].mean() < 0.6 * off[0][of_motion].mean()
