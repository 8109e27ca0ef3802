from dataclasses import replace

import numpy as np
import pytest

from smplxpp.core.errors import InputError
from smplxpp.reconstruct.mask_consensus import find_consensus
from smplxpp.reconstruct.views import Silhouette
from tests.reconstruct.scene import RADIUS, dented_views


def consensus(views):
    return find_consensus([Silhouette.of(view) for view in views])


def turned(view):
    return replace(view, opacity=255 - view.opacity)


def shifted(view, pixels):
    return replace(view, opacity=np.roll(view.opacity, pixels, axis=1))


def cut(view):
    """Without the upper 40 % of the mask."""
    rows = np.flatnonzero(view.opacity.any(axis=1))
    opacity = view.opacity.copy()
    opacity[: rows[0] + int(0.4 * len(rows))] = 0
    return replace(view, opacity=opacity)


@pytest.mark.long
def test_good_masks_are_all_trusted_and_the_box_holds_the_body():
    found = consensus(dented_views(plain=True))
    assert found.trusted.all() and not found.reasons
    assert found.explained.min() > 0.95
    assert (found.box.low < -RADIUS).all() and (found.box.high > RADIUS).all()
    assert (found.box.high - found.box.low < 3 * RADIUS).all()


@pytest.mark.parametrize("spoil", [turned, cut, lambda view: shifted(view, 30)], ids=["turned", "cut", "shifted"])
@pytest.mark.long
def test_bad_masks_are_named_and_no_others(spoil):
    which = (3, 8)
    views = list(dented_views(plain=True))
    for k in which:
        views[k] = spoil(views[k])
    found = consensus(views)
    assert set(found.reasons) == {views[k].name for k in which}
    assert not found.trusted[list(which)].any()


@pytest.mark.long
def test_the_order_of_the_views_does_not_matter():
    views = list(dented_views(plain=True))
    views[5] = cut(views[5])
    order = np.random.default_rng(0).permutation(len(views))
    one, other = consensus(views), consensus([views[k] for k in order])
    assert set(one.reasons) == set(other.reasons) == {views[5].name}
    assert other.explained == pytest.approx(one.explained[order], abs=1e-9)


@pytest.mark.long
def test_masks_a_pixel_or_two_off_are_trusted():
    from scipy import ndimage

    views = []
    for k, view in enumerate(dented_views(plain=True)):
        change = ndimage.grey_erosion if k % 2 else ndimage.grey_dilation
        views.append(replace(view, opacity=change(view.opacity, size=(3, 3))))
    assert consensus(views).trusted.all()


@pytest.mark.long
def test_masks_that_contradict_each_other_are_refused():
    views = [shifted(view, (-1) ** k * 35) for k, view in enumerate(dented_views(plain=True))]
    with pytest.raises(InputError, match="silhouettes of one body"):
        consensus(views)
