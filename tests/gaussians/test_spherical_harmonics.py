"""Colour by direction."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from avatar.gaussians.binding import world_from_frames
from avatar.gaussians.colors import sh_color, view_colors
from avatar.gaussians.frames import triangle_frames
from smplxpp.core.errors import InputError
from smplxpp.core.spherical_harmonics import C0, coefficient_count, rotate_sh, sh_basis
from tests.gaussians.bound_scenes import random_bound, rotation, sphere


def directions(count: int = 50) -> torch.Tensor:
    g = torch.Generator().manual_seed(3)
    return torch.nn.functional.normalize(torch.randn((count, 3), generator=g, dtype=torch.float64), dim=-1)


def test_basis_is_the_real_form_of_scipys_harmonics():
    d = directions()
    x, y, z = d.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    expected = []
    for degree in (1, 2, 3):
        for m in range(-degree, degree + 1):
            complex_form = sph_harm_y(degree, abs(m), polar, azimuth)
            part = complex_form.imag if m < 0 else complex_form.real
            # scipy's functions carry the Condon-Shortley phase, and so do 3DGS's.
            expected.append(part * (1.0 if m == 0 else 2.0**0.5))
    np.testing.assert_allclose(sh_basis(d, 3).numpy(), np.stack(expected, 1), atol=1e-12)
    np.testing.assert_allclose(C0, sph_harm_y(0, 0, 0.0, 0.0).real)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_lower_degrees_are_the_first_columns(degree):
    d = directions()
    torch.testing.assert_close(sh_basis(d, degree), sh_basis(d, 3)[:, : coefficient_count(degree)])


def test_harmonics_are_orthonormal():
    # Gauss-Legendre in z and even steps in azimuth integrate degree 6 exactly.
    nodes, weights = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * (np.pi / 8)
    z, a = np.meshgrid(nodes, azimuth, indexing="ij")
    r = np.sqrt(1 - z * z)
    d = torch.tensor(np.stack([r * np.cos(a), r * np.sin(a), z], -1).reshape(-1, 3))
    w = torch.tensor(np.repeat(weights, 16) * (np.pi / 8))
    basis = sh_basis(d, 3)
    gram = basis.T @ (w[:, None] * basis)
    torch.testing.assert_close(gram, torch.eye(15, dtype=torch.float64), atol=1e-9, rtol=0)


def test_colour_is_added_before_the_clamp():
    dc = torch.tensor([[0.2, 0.5, 0.9]], dtype=torch.float64)
    sh = torch.zeros(1, 3, 3, dtype=torch.float64)
    sh[0, 1] = -1.0  # the coefficient of z
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    down = 0.4886025119029199
    expected = torch.tensor([[0.0, 0.5 - down, 0.9 - down]], dtype=torch.float64)
    torch.testing.assert_close(sh_color(dc, sh, up), expected)
    torch.testing.assert_close(sh_color(dc, sh, -up), dc + down)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_do_not_change_when_mesh_and_camera_turn_together(degree):
    vertices, faces = sphere()
    bound = random_bound(faces, degree=degree)
    cameras = torch.tensor([[0.0, 1.0, 3.0], [2.0, 0.0, -1.0]], dtype=torch.float64)
    turn, shift = rotation(0.5, 2.0, -1.0), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)

    def colors(vertices, cameras):
        frames = triangle_frames(vertices, faces)
        return view_colors(bound, frames, world_from_frames(bound, frames).means, cameras)

    here, there = colors(vertices, cameras), colors(vertices @ turn.T + shift, cameras @ turn.T + shift)
    assert here.shape == (2, len(bound), 3) and here.min() >= 0
    torch.testing.assert_close(there, here)
    if degree:
        assert (colors(vertices @ turn.T, cameras) - here).abs().max() > 0.01


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_coefficients_in_the_world_give_the_colours_of_the_local_ones(degree):
    vertices, faces = sphere()
    bound = random_bound(faces, degree=degree)
    rotations = triangle_frames(vertices, faces).rotations[bound.face_index]
    world_sh = rotate_sh(bound.sh, rotations)
    for d in directions(20):
        local = sh_color(bound.dc, bound.sh, (rotations.mT @ d))
        torch.testing.assert_close(sh_color(bound.dc, world_sh, d.expand(len(bound), 3)), local)
    torch.testing.assert_close(rotate_sh(world_sh, rotations.mT), bound.sh)


def test_rotation_keeps_degrees_apart_and_energy():
    _, faces = sphere()
    sh = random_bound(faces, degree=3).sh
    turned = rotate_sh(sh, rotation(1.0, 2.0, 0.5).expand(len(sh), 3, 3))
    for low, high in ((0, 3), (3, 8), (8, 15)):
        torch.testing.assert_close(turned[:, low:high].norm(dim=1), sh[:, low:high].norm(dim=1))


def test_gradients():
    vertices, faces = sphere()
    bound = random_bound(faces, count=5, degree=3)
    frames = triangle_frames(vertices, faces)
    means = world_from_frames(bound, frames).means.requires_grad_(True)
    cameras = torch.tensor([[0.0, 1.0, 3.0], [2.0, 0.0, -1.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda m, c: view_colors(bound, frames, m, c), [means, cameras])
    d = directions(5).requires_grad_(True)
    inputs = [bound.dc.clone().requires_grad_(True), bound.sh.clone().requires_grad_(True), d]
    assert torch.autograd.gradcheck(sh_color, inputs)


@pytest.mark.parametrize("degree", [-1, 4, 1.5])
def test_degrees_out_of_range_are_refused(degree):
    with pytest.raises(InputError, match="degree"):
        sh_basis(directions(1), degree)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("means", lambda means, cameras: (means[1:], cameras)),
        ("means", lambda means, cameras: (means.float(), cameras)),
        ("camera positions", lambda means, cameras: (means, cameras[0])),
        ("camera positions", lambda means, cameras: (means, cameras.float())),
    ],
)
def test_arguments_that_do_not_fit_are_refused(name, change):
    vertices, faces = sphere()
    bound = random_bound(faces)
    frames = triangle_frames(vertices, faces)
    means, cameras = change(world_from_frames(bound, frames).means, torch.zeros(2, 3, dtype=torch.float64))
    with pytest.raises(InputError, match=name):
        view_colors(bound, frames, means, cameras)
    with pytest.raises(InputError, match="rotations"):
        view_colors(bound, triangle_frames(vertices[None], faces), means, cameras)
