from dataclasses import replace

import numpy as np
import pytest

from smplxpp.core.errors import InputError
from smplxpp.reconstruct.views import check_spread, mask_fault, usable_views, widest_gap
from tests.reconstruct.scene import dented_views


def test_two_cameras_are_refused():
    with pytest.raises(InputError, match="at least 4 cameras"):
        usable_views(dented_views()[:2])


def test_a_photograph_of_another_size_is_refused():
    views = list(dented_views())
    views[0] = replace(views[0], opacity=views[0].opacity[:-1], color=views[0].color[:-1])
    with pytest.raises(InputError, match="view cam00"):
        usable_views(views)


def test_masks_of_the_background_are_refused_with_what_to_do():
    with pytest.raises(InputError, match="Invert the masks") as caught:
        usable_views([replace(view, opacity=255 - view.opacity) for view in dented_views()])
    assert "cam00: of the background" in caught.value.received


def test_empty_and_full_masks_are_refused():
    for value in (0, 255):
        views = [replace(view, opacity=np.full_like(view.opacity, value)) for view in dented_views()]
        with pytest.raises(InputError, match="Make new masks"):
            usable_views(views)


def test_a_few_bad_masks_are_left_out_and_named():
    views = list(dented_views())
    views[1] = replace(views[1], opacity=np.zeros_like(views[1].opacity))
    views[4] = replace(views[4], opacity=255 - views[4].opacity)
    good, faults = usable_views(views)
    assert len(good) == len(views) - 2
    assert faults["cam01"] == "empty" and faults["cam04"].startswith("of the background")


def test_a_close_up_is_no_mask_of_the_background():
    view = dented_views()[0]
    opacity = np.zeros_like(view.opacity)
    opacity[40:, 20:-20] = 255  # shoulders at the lower border
    assert mask_fault(replace(view, opacity=opacity)) == ""


def test_cameras_on_one_side_are_refused_and_a_gap_is_told():
    cameras = [view.camera for view in dented_views()]
    assert check_spread(np.zeros(3), cameras) == ""
    front = [camera for camera in cameras if camera.position[2] > 1.2]
    with pytest.raises(InputError, match="Add cameras behind the person"):
        check_spread(np.zeros(3), front)
    half = [camera for camera in cameras if camera.position[2] > -0.3]
    assert "no camera stands within" in check_spread(np.zeros(3), half)


def test_the_widest_gap_is_found_across_the_end_of_the_circle():
    angles = np.radians([10.0, 100.0, 200.0])
    gap, middle = widest_gap(np.stack([np.sin(angles), np.zeros(3), np.cos(angles)], axis=1))
    assert gap == pytest.approx(170.0)
    assert np.degrees(np.arctan2(*middle)) % 360 == pytest.approx(285.0)
