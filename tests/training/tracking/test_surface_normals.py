"""Normals of the followed surface: a ball's by its equation, where the mask says person, and a term of the loss."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.data.sequence import AvatarSequence
from avatar.models.tracked_surface import ControlCage, SurfaceNormals, Track
from avatar.training.engine.photometric_task import ALONE, PhotometricConfig, PhotometricTask, with_surface_normals
from smplxpp.capture.files import FileSeries
from tests.dolls.standing import opened, rig, still

HEAD = np.array([0.0, 0.78, 0.0])
LIFT = 0.05
EVERYTHING = rig().template.part_names


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    capture = opened(tmp_path_factory.mktemp("captures") / "doll")
    return AvatarSequence(capture, rig().template)


@pytest.fixture(scope="module")
def track(frames) -> Track:
    """Frame 0 stands still, frame 1 is lifted as a whole; the others were not followed."""
    cage = ControlCage(frames.rig, 40)
    controls = torch.zeros(2, cage.count, 3)
    controls[1, :, 1] = LIFT
    return Track({0: 0, 1: 1}, controls, cage)


def seen_points(view, normals) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays through the pixels that have normals, and these."""
    rows, columns = np.nonzero(normals.any(-1))
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    rays = pixels @ np.linalg.inv(view.camera.K).T @ view.camera.cam_from_world[:3, :3]
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), normals[rows, columns]


@pytest.mark.parametrize(("frame", "up"), [(0, 0.0), (1, LIFT)])
def test_normals_of_a_ball_are_its_radii(frames, track, frame, up):
    view = frames.whole_view("Face", 0)  # the camera sees little but the head
    whole = replace(view, alpha=torch.full_like(view.alpha, 255))
    normals = SurfaceNormals(frames, track, EVERYTHING)(whole, frame).normals.double().numpy()
    rays, found = seen_points(view, normals)
    assert len(found) > 400
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=2e-3)
    away = HEAD + [0.0, up, 0.0] - view.camera.position
    along = rays @ away
    discriminant = along**2 - away @ away + 0.13**2
    on_head = discriminant > 0.03**2  # not the rim, where a polygon is no ball, nor the torso
    points = rays * (along - np.sqrt(np.maximum(discriminant, 0.0)))[:, None]
    radii = (points - away) / 0.13
    assert on_head.sum() > 200
    assert np.degrees(np.arccos(np.clip((radii * found).sum(1)[on_head], -1, 1))).max() < 8.0


def test_pixels_off_the_mask_and_frames_that_were_not_followed_have_none(frames, track):
    view = frames.view("Ring0", 0)
    shown = SurfaceNormals(frames, track, EVERYTHING)(view, 0)
    assert view.normals is None and not shown.normals[view.alpha < 128].any()
    assert shown.normals.any(-1)[view.alpha == 255].float().mean() > 0.9
    assert SurfaceNormals(frames, track)(view, 2) is view


def test_skin_has_none_unless_it_is_asked_for(frames, track):
    view = frames.view("Ring0", 0)
    assert rig().template.part_names == ("body",)
    assert SurfaceNormals(frames, track, ("body",))(view, 0).normals.any()
    assert not SurfaceNormals(frames, track)(view, 0).normals.any()
    assert not SurfaceNormals(frames, track, ("hair",))(view, 0).normals.any()


def test_the_surface_stands_for_maps_only_where_a_capture_has_none(frames, track, tmp_path):
    assert with_surface_normals(ALONE, frames, None) is ALONE
    assert with_surface_normals(ALONE, frames, track).surface is not None
    series = FileSeries.from_names(tmp_path, {0: "Ring0_normal000000.png"})
    recording = frames.capture.recording
    with_map = replace(recording, files={**recording.files, "normal": {"Ring0": series}})
    mapped = AvatarSequence(replace(frames.capture, recording=with_map), frames.rig.template)
    assert mapped.normal_maps == 1 and frames.normal_maps == 0
    assert with_surface_normals(ALONE, mapped, track) is ALONE


class Still(PhotometricTask):
    """A student that nothing moves."""

    def loss(self, item):
        views = self.views(item)
        posed = self.model(self.sequence.pose(item.frame), torch.stack([view.position for view in views]))
        total, terms, _ = self.compared(posed, views)
        return total, terms


def test_the_loss_has_its_normal_term_with_the_surface_alone(frames, track):
    item = frames.items(0, count=1, views=2, seed=0)[0]
    item = replace(item, frame=0)
    config = PhotometricConfig(iterations=1, attributes=1.0)

    def terms(context, weights=config.weights):
        return Still(frames, still(frames.rig), replace(config, weights=weights), [], context).loss(item)[1]

    surface = replace(ALONE, surface=SurfaceNormals(frames, track, EVERYTHING))
    assert "normal" not in terms(ALONE)
    assert 0.0 < terms(surface)["normal"] < 1.0
    assert "normal" not in terms(surface, replace(config.weights, normal=0.0))
