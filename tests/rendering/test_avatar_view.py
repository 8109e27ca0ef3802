"""A posed avatar through a camera: crops, channels and cameras agree with drawing each alone."""

from __future__ import annotations

import pytest
import torch

from avatar.data.sequence import camera_centers_of
from avatar.data.views import View
from avatar.models.student import Student, StudentConfig
from avatar.rendering.api import rasterize
from avatar.rendering.avatar_view import render_view
from avatar.rig.rig import PosedAvatar, Rig
from tests.dolls.dancing import HEIGHT, WIDTH, cameras, dance, gaussians, template, varied

GREY = torch.tensor([0.2, 0.4, 0.6])


def views() -> list[View]:
    """Of two cameras, with a mask that touches neither border."""
    alpha = torch.zeros(HEIGHT, WIDTH, dtype=torch.uint8)
    alpha[14:50, 10:37] = 255
    return [
        View(cameras()[name], torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8), alpha) for name in ("Ring0", "Ring1")
    ]


@pytest.fixture(scope="module")
def posed() -> PosedAvatar:
    rig = Rig(template())
    model = Student(StudentConfig(field=None), rig, varied(gaussians()), ())
    with torch.no_grad():
        return model(rig.pose(dance().frame(2)), camera_centers_of(views()))


@pytest.mark.parametrize("index", [0, 1])
def test_colour_is_that_of_the_rasteriser_on_the_background(posed, index):
    view, world = views()[index], posed.gaussians
    seen = render_view(posed, index, view, GREY, eps2d=0.3)
    image, alpha, _ = rasterize(
        world.means,
        world.quats,
        world.scales,
        world.opacities,
        posed.colors[index][None],
        view.viewmat[None],
        view.K[None],
        WIDTH,
        HEIGHT,
        background=GREY,
        eps2d=0.3,
    )
    torch.testing.assert_close(seen.image, image[0])
    torch.testing.assert_close(seen.alpha, alpha[0, ..., 0])
    assert seen.normals is None and seen.extra is None
    torch.testing.assert_close(seen.image[0, 0], GREY)  # nobody is in the corner
    assert seen.alpha.max() > 0.9


def test_normals_and_extra_values_are_blended_as_colour_is_and_do_not_change_it(posed):
    view, world = views()[1], posed.gaussians
    extra = torch.rand(len(world.means), 4, generator=torch.Generator().manual_seed(0))
    alone = render_view(posed, 1, view, GREY)
    both = render_view(posed, 1, view, GREY, normals=True, extra=extra)
    torch.testing.assert_close(both.image, alone.image)
    torch.testing.assert_close(both.extra, render_view(posed, 1, view, GREY, extra=extra).extra)
    drawn = rasterize(
        world.means,
        world.quats,
        world.scales,
        world.opacities,
        world.normals[None],
        view.viewmat[None],
        view.K[None],
        WIDTH,
        HEIGHT,
        background=torch.zeros(3),
        eps2d=0.1,
    )[0][0]
    torch.testing.assert_close(both.normals, drawn)
    assert both.extra.shape == (HEIGHT, WIDTH, 4)
    assert not both.normals[0, 0].any() and not both.extra[0, 0].any()


def test_normals_face_the_camera_where_the_person_is_opaque(posed):
    view = views()[0]
    seen = render_view(posed, 0, view, GREY, normals=True)
    towards = view.position - torch.tensor([0.0, 0.45, 0.0])
    solid = seen.alpha > 0.95
    facing = (seen.normals[solid] @ (towards / towards.norm())) > 0
    assert facing.float().mean() > 0.95


def test_a_cropped_view_is_that_part_of_the_whole(posed):
    whole = views()[0]
    part = whole.cropped(3)
    seen = render_view(posed, 0, whole, GREY, normals=True)
    crop = render_view(posed, 0, part, GREY, normals=True)
    assert crop.image.shape == (50 - 14 + 6, 37 - 10 + 6, 3)
    torch.testing.assert_close(crop.image, seen.image[11:53, 7:40], rtol=0, atol=2e-5)
    torch.testing.assert_close(crop.normals, seen.normals[11:53, 7:40], rtol=0, atol=2e-5)


def test_a_halved_view_shows_the_same_at_half_the_size(posed):
    """Means of 2 x 2 pixels of the fine picture, but for the blur that is of a fixed number of pixels."""
    view = views()[0]
    fine = render_view(posed, 0, view, GREY, eps2d=0.4).image
    coarse = render_view(posed, 0, view.halved(), GREY, eps2d=0.1).image
    pooled = fine.view(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3))
    assert (coarse - pooled).abs().mean() < 0.01
    shifted = pooled.roll(1, dims=1)
    assert (coarse - pooled).abs().mean() < 0.3 * (coarse - shifted).abs().mean()


def test_gradients_go_through(posed):
    rig = Rig(template())
    model = Student(StudentConfig(field=None), rig, varied(gaussians()), ())
    own = model(rig.pose(dance().frame(2)), camera_centers_of(views()))
    seen = render_view(own, 1, views()[1], GREY, normals=True, extra=torch.ones(len(model.gaussians), 1))
    (seen.image.sum() + seen.normals.square().sum() + seen.extra.sum()).backward()
    for name in ("offset", "log_scales", "quats", "opacity_logits", "dc", "sh"):
        assert getattr(model.gaussians, name).grad.abs().sum() > 0, name
