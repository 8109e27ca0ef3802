"""More Gaussians where photographs change quickly."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from avatar.data.views import View
from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.sampling import SamplingConfig
from avatar.rig.rig import Rig
from avatar.training.fit.initial_gaussians import changes, density_of_detail, initial_gaussians
from smplxpp.core.camera import Camera
from tests.dolls.standing import TRAIN, doll

SAMPLING = SamplingConfig(count=3000, head_share=None, hidden_density=1.0)


def flat_view(image: np.ndarray) -> View:
    height, width = image.shape[:2]
    camera = Camera(np.eye(3), np.eye(4), width, height, name="flat")
    return View(camera, torch.tensor(image), torch.full((height, width), 255, dtype=torch.uint8))


def test_a_ramp_changes_by_its_slope():
    ramp = np.zeros((12, 20, 3), np.uint8)
    ramp[..., 0] = 7 * np.arange(20)
    ramp[..., 1] = 5 * np.arange(12)[:, None]
    inside = changes(flat_view(ramp)).foreground[1:-1, 1:-1]
    assert (inside[..., 0] == 7).all() and (inside[..., 1] == 5).all() and not inside[..., 2].any()


def test_what_is_beside_the_background_does_not_count():
    image, alpha = np.full((12, 12, 3), 200, np.uint8), np.full((12, 12), 255, np.uint8)
    image[:, :6], alpha[:, :6] = 0, 0
    changed = changes(replace(flat_view(image), alpha=torch.tensor(alpha)))
    kept = changed.alpha == 255
    assert not kept[:, :7].any() and kept[:, 7:].all()
    assert not changed.foreground[kept].any()


def test_density_grows_with_the_changes_nearby():
    template = doll().template
    centers = template.mesh.triangles.mean(1)
    faces, right = np.arange(len(centers)), centers[:, 0] > np.median(centers[:, 0])
    rates = np.where(right, 0.4, 0.1)[:, None].repeat(3, 1)
    seen = np.ones(len(faces), bool)
    density = density_of_detail(template, faces, rates, seen, 2.0)
    usual = np.sqrt((np.square(rates).sum(1)).mean())
    assert density.max() == pytest.approx(1.0 + 2.0 * 0.4 * np.sqrt(3.0) / usual)
    assert density.min() == pytest.approx(1.0 + 2.0 * 0.1 * np.sqrt(3.0) / usual)
    assert density[right].mean() > density[~right].mean()
    np.testing.assert_array_equal(density_of_detail(template, faces, rates, seen, 0.0), 1.0)


@pytest.mark.parametrize("seen", [True, False])
def test_plain_or_unseen_photographs_change_nothing(seen):
    template = doll().template
    faces = np.arange(len(template.faces))
    rates = np.full((len(faces), 3), 0.0 if seen else 0.3)
    np.testing.assert_array_equal(density_of_detail(template, faces, rates, np.full(len(faces), seen), 2.0), 1.0)


def test_what_no_view_shows_is_as_dense_as_what_lies_nearest():
    template = doll().template
    centers = template.mesh.triangles.mean(1)
    faces = np.arange(len(centers))
    top = centers[:, 1] > np.median(centers[:, 1])
    rates = np.where(top, 0.4, 0.1)[:, None].repeat(3, 1)
    seen = np.zeros(len(faces), bool)
    seen[::3] = True
    density = density_of_detail(template, faces, rates, seen, 2.0)
    assert np.corrcoef(density, top)[0, 1] > 0.9


def above_the_middle(gaussians: BoundGaussians) -> float:
    centers = doll().template.mesh.triangles.mean(1)
    return float((centers[gaussians.face_index, 1] > np.median(centers[:, 1])).mean())


def test_a_fit_starts_with_fewer_gaussians_where_photographs_show_one_colour():
    it = doll()
    striped = [View(it.cameras[n], torch.tensor(it.images[n]), torch.tensor(it.masks[n])) for n in TRAIN]
    middle = np.median(it.template.mesh.triangles.mean(1)[:, 1])
    plain, half_plain = [], []
    for view in striped:
        row = round(float(view.camera.screen_from_world(np.array([[0.0, middle, 0.0]]))[0, 1]))
        halves = view.foreground.clone()
        halves[:row] = 90
        half_plain.append(replace(view, foreground=halves))
        plain.append(replace(view, foreground=torch.full_like(halves, 90)))
    start = partial(initial_gaussians, Rig(it.template), it.template.vertices)
    even = start(striped, SAMPLING)
    assert above_the_middle(start(half_plain, SAMPLING, detail=4.0)) < 0.8 * above_the_middle(even)
    assert torch.equal(start(plain, SAMPLING, detail=4.0).face_index, even.face_index)
    one, again = (start(striped, SAMPLING, detail=4.0) for _ in range(2))
    assert len(one) == SAMPLING.count
    assert all(torch.equal(a, b) for a, b in zip(one.tensors.values(), again.tensors.values(), strict=True))
