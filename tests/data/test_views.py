"""Views of a capture: cut to the person, composited, and what is missing."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from PIL import Image

from avatar.data.views import View, read_views
from smplxpp.capture import open_capture
from smplxpp.core.errors import GeometryWarning, InputError
from tests.dolls.standing import HELD_OUT, TRAIN, doll, write_capture


@pytest.fixture
def capture_folder(tmp_path):
    return write_capture(tmp_path / "doll")


def test_views_are_the_files(capture_folder):
    views = read_views(open_capture(capture_folder), 0, (*TRAIN, *HELD_OUT))
    assert [view.name for view in views] == [*TRAIN, *HELD_OUT]
    for view in views:
        np.testing.assert_array_equal(view.foreground.numpy(), doll().images[view.name])
        np.testing.assert_array_equal(view.alpha.numpy(), doll().masks[view.name])
        np.testing.assert_allclose(view.position.numpy(), doll().cameras[view.name].position, atol=1e-6)


def test_a_cut_shows_the_same_pixels_through_the_same_camera(capture_folder):
    whole = read_views(open_capture(capture_folder), 0, ["Ring1"])[0]
    cut = whole.cropped(3)
    assert cut.camera.width < whole.camera.width and cut.camera.height < whole.camera.height
    shift = whole.camera.K[:2, 2] - cut.camera.K[:2, 2]
    left, top = shift.astype(int)
    assert np.array_equal(shift, (left, top))
    part = (slice(top, top + cut.camera.height), slice(left, left + cut.camera.width))
    assert torch.equal(cut.foreground, whole.foreground[part])
    assert int(cut.alpha.sum()) == int(whole.alpha.sum())  # nothing of the person is lost
    points = doll().template.vertices[::50]
    there, here = whole.camera.screen_from_world(points), cut.camera.screen_from_world(points)
    np.testing.assert_allclose(there[:, :2] - here[:, :2], np.tile(shift, (len(points), 1)), atol=1e-9)
    rows, columns = torch.nonzero(cut.alpha[3:-3, 3:-3]).T
    assert rows.min() == columns.min() == 0  # the margin is kept on every side that the image has


def test_an_empty_mask_is_not_cut():
    camera = doll().cameras["Ring0"]
    view = View(camera, torch.zeros(80, 64, 3, dtype=torch.uint8), torch.zeros(80, 64, dtype=torch.uint8))
    assert view.cropped(3).camera.width == 64


def test_composition_is_linear_in_the_background(capture_folder):
    view = read_views(open_capture(capture_folder), 0, ["Ring0"])[0]
    black, red = torch.zeros(3), torch.tensor([1.0, 0.0, 0.0])
    added = view.composited(red) - view.composited(black)
    torch.testing.assert_close(added[..., 0], 1 - view.alpha / 255)
    assert not added[..., 1:].any()
    np.testing.assert_array_equal(view.photograph((0, 0, 0)), doll().images["Ring0"])


def test_cameras_without_an_image_or_a_person_are_left_out_with_their_names(capture_folder):
    (capture_folder / "rgbs/Ring1/Ring1_rgb000000.png").unlink()
    mask = capture_folder / "masks/Ring2/Ring2_mask000000.png"
    Image.fromarray(np.zeros((80, 64), np.uint8)).save(mask)
    with pytest.warns(GeometryWarning) as caught:
        views = read_views(open_capture(capture_folder), 0, TRAIN)
    assert [view.name for view in views] == [name for name in TRAIN if name not in ("Ring1", "Ring2")]
    assert "Ring1: no image" in str(caught[0].message) and "Ring2: no person" in str(caught[1].message)


def test_unknown_cameras_and_images_of_another_size_are_refused(capture_folder):
    capture = open_capture(capture_folder)
    with pytest.raises(InputError, match="Nonsense"):
        read_views(capture, 0, ["Nonsense"])
    cameras = json.loads((capture_folder / "cameras.json").read_text())
    cameras["cameras"][0]["w"] += 1
    (capture_folder / "cameras.json").write_text(json.dumps(cameras))
    with pytest.raises(InputError, match=r"Ring0_rgb000000\.png"):
        read_views(open_capture(capture_folder), 0, ["Ring0"])
