"""Bound Gaussians as splats of a pose, and as the texture of a template."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.export.posed import posed_splats, student_texture
from avatar.gaussians.binding import world_from_local
from avatar.gaussians.colors import sh_color, view_colors
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.gaussians.tensor_operations import matrix_from_quat
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from smplxpp.core import InputError
from smplxpp.core.spherical_harmonics import C0
from smplxpp.template.mouth import inside_of_mouth
from tests.export.templates import open_body_template
from tests.gaussians.bound_scenes import random_bound, rotation, sphere


def test_posed_splats_are_the_world_gaussians():
    vertices, faces = sphere()
    bound = random_bound(faces, degree=2)
    splats = posed_splats(bound, vertices, faces)
    world = world_from_local(bound, vertices, faces)
    np.testing.assert_allclose(splats.means, world.means, rtol=1e-6)
    np.testing.assert_allclose(np.exp(splats.log_scales), world.scales, rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-splats.opacity_logits)), world.opacities, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(splats.quats, axis=1), 1.0, rtol=1e-6)
    theirs = matrix_from_quat(torch.tensor(splats.quats, dtype=torch.float64))
    torch.testing.assert_close(theirs, matrix_from_quat(world.quats), atol=1e-6, rtol=0)
    np.testing.assert_allclose(splats.normals, theirs[..., 0], atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_viewer_sees_the_colours_that_we_render(degree):
    """Colours by 3DGS's formula, in the world's axes, against ours in the triangles' frames."""
    vertices, faces = sphere()
    bound = random_bound(faces, degree=degree)
    vertices = vertices @ rotation(0.4, 1.0, -2.0).T
    splats = posed_splats(bound, vertices, faces)
    camera = torch.tensor([[0.5, 1.5, 2.0]], dtype=torch.float64)
    frames = triangle_frames(vertices, faces)
    ours = view_colors(bound, frames, world_from_local(bound, vertices, faces).means, camera)[0]
    directions = torch.nn.functional.normalize(torch.tensor(splats.means).double() - camera, dim=-1)
    f_dc, f_rest = (torch.tensor(a, dtype=torch.float64) for a in (splats.f_dc, splats.f_rest))
    torch.testing.assert_close(sh_color(0.5 + C0 * f_dc, f_rest, directions), ours, atol=1e-6, rtol=0)


@torch.no_grad()
@pytest.mark.long
def test_a_students_texture_shows_its_colours_where_pictures_see_it_and_the_templates_elsewhere():
    pytest.importorskip("xatlas")
    template = open_body_template()
    template = replace(template, vertex_colors=np.full((template.vertex_count, 3), 200, np.uint8))
    rig = Rig(template)
    gaussians = sample_on_mesh(template, SamplingConfig(count=6000, head_share=None))
    student = Student(StudentConfig(field=None), rig, gaussians, ())
    # Red above the waist, blue below it; Gaussians large and opaque enough to leave no gaps.
    low = template.vertices[template.faces].mean(axis=1)[student.gaussians.face_index.numpy()][:, 1] < -0.3
    red, blue = torch.tensor([0.8, 0.2, 0.2]), torch.tensor([0.2, 0.2, 0.8])
    student.gaussians.dc.copy_(torch.where(torch.tensor(low)[:, None], blue, red))
    student.gaussians.opacity_logits.fill_(6.0)
    student.gaussians.log_scales.add_(0.4)
    texture = student_texture(student, size=1024)
    picture = texture.color_image(0) / 255.0
    middles = texture.uv[texture.face_uv].mean(axis=1)
    colors = picture[(middles[:, 1] * 1024).astype(int), (middles[:, 0] * 1024).astype(int)]
    height, ahead = template.mesh.face_centers[:, 1], template.mesh.face_normals[:, 2] > 0.8
    body = template.mesh.face_areas > np.median(template.mesh.face_areas)
    for rows, color in ((ahead & body & (height > -0.1), red), (ahead & body & (height < -0.6), blue)):
        np.testing.assert_allclose(np.median(colors[rows], axis=0), color, atol=0.06)
    inside = inside_of_mouth(template)[template.faces].all(axis=1)
    np.testing.assert_allclose(np.median(colors[inside], axis=0), 200 / 255.0, atol=0.06)
    with pytest.raises(InputError, match="texture size"):
        student_texture(student, size=1000)
