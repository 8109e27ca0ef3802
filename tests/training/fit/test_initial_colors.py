"""Colours taken from photographs."""

from __future__ import annotations

import numpy as np
import torch

from avatar.data.views import View
from avatar.training.fit.initial_gaussians import colors_from_views
from smplxpp.core.mesh import TriangleMesh, concatenate_meshes
from tests.dolls.doll import paint
from tests.dolls.standing import STRIPES, TRAIN, doll


def views(*names: str) -> list[View]:
    it = doll()
    return [View(it.cameras[n], torch.tensor(it.images[n]), torch.tensor(it.masks[n])) for n in names]


def surface() -> tuple[TriangleMesh, np.ndarray, np.ndarray]:
    mesh = doll().template.mesh
    return mesh, mesh.triangles.mean(1), mesh.face_normals


def test_points_take_the_colour_they_are_painted_in():
    mesh, points, normals = surface()
    colors, seen = colors_from_views(points, normals, torch.zeros(len(points), 3), mesh=mesh, views=views(*TRAIN))
    assert 0.7 < seen.mean() < 1.0  # soles and top face no camera
    error = np.abs(colors.numpy()[seen] - paint(points[seen], STRIPES)).max(1)
    assert np.percentile(error, 95) < 0.06 and error.max() < 0.2
    assert colors.dtype == torch.float32


def test_one_view_colours_its_own_side_and_leaves_the_rest():
    mesh, points, normals = surface()
    camera = doll().cameras["Ring0"]
    fallback = torch.full((len(points), 3), 0.25)
    colors, seen = colors_from_views(points, normals, fallback, mesh=mesh, views=views("Ring0"))
    facing = ((camera.position - points) * normals).sum(1) > 0
    assert seen.any() and not (seen & ~facing).any()
    assert torch.equal(colors[~torch.tensor(seen)], fallback[~torch.tensor(seen)])


def test_what_something_else_hides_takes_nothing():
    mesh, points, normals = surface()
    camera = doll().cameras["Ring0"]
    center = points.mean(0)
    screen = TriangleMesh(
        center + 0.5 * (camera.position - center) + np.array([[-1, -1, 0], [1, -1, 0], [0, 2, 0]]),
        np.array([[0, 1, 2]]),
    )
    hidden = concatenate_meshes([mesh, screen])
    _, seen = colors_from_views(points, normals, torch.zeros(len(points), 3), mesh=hidden, views=views("Ring0"))
    assert not seen.any()
