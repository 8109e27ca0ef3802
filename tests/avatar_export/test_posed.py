"""Bound Gaussians as splats of a pose."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.export.posed import posed_splats
from avatar.gaussians.binding import world_from_local
from avatar.gaussians.colors import sh_color, view_colors
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.tensor_operations import matrix_from_quat
from smplxpp.core.spherical_harmonics import C0
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
