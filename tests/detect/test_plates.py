"""Masks from empty plates: people against backgrounds, with noise, shadows and changed exposure."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage

from smplxpp.core.errors import InputError
from smplxpp.detect.plates import PlateConfig, PlateModel, cleaned

SIZE = (120, 90)


def room(seed: int = 0) -> np.ndarray:
    """A background with soft colours and edges."""
    rng = np.random.default_rng(seed)
    smooth = scipy.ndimage.gaussian_filter(rng.uniform(0, 255, (*SIZE, 3)), (12, 12, 0)) * 4 - 380
    smooth[:, 30:40] += 30
    return np.clip(smooth, 40, 220)


def person_mask() -> np.ndarray:
    """A round head, a body, two legs with a gap between them."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    mask = (y - 25) ** 2 + (x - 45) ** 2 < 100
    mask |= (y >= 34) & (y < 70) & (abs(x - 45) < 16)
    return mask | ((y >= 70) & (y < 110) & (abs(abs(x - 45) - 9) < 6))


def shot(clean: np.ndarray, seed: int, noise: float = 3.0) -> np.ndarray:
    """A photograph with noise."""
    rng = np.random.default_rng(seed)
    return np.clip(clean + rng.normal(0, noise, clean.shape), 0, 255).astype(np.uint8)


def with_person(background: np.ndarray) -> np.ndarray:
    out = background.copy()
    out[person_mask()] = (200, 60, 90)
    return out


def overlap(matte: np.ndarray, mask: np.ndarray) -> float:
    found = matte > 127
    return float((found & mask).sum() / (found | mask).sum())


@pytest.mark.parametrize("count", [1, 5])
@pytest.mark.parametrize("seed", range(3))
def test_a_person_is_cut_out_of_a_noisy_room(count, seed):
    model = PlateModel([shot(room(seed), 10 + k) for k in range(count)])
    matte = model(shot(with_person(room(seed)), 99))
    assert matte.dtype == np.uint8 and overlap(matte, person_mask()) > 0.95
    assert not (model(shot(room(seed), 100)) > 127).any()


def test_a_shadow_is_not_the_person():
    background = room()
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    shadow = np.clip(((y - 105) / 10.0) ** 2 + ((x - 60) / 28.0) ** 2, 0.0, 1.0)[..., None]
    shaded = background * (0.62 + 0.38 * shadow)
    picture = with_person(shaded)
    model = PlateModel([shot(background, k) for k in range(3)])
    assert overlap(model(shot(picture, 99)), person_mask()) > 0.94
    # It is the shadow that is hard: one that is taken for the person spoils the mask.
    naive = PlateModel([shot(background, k) for k in range(3)], PlateConfig(darkest_shadow=1.0 - 1e-9))
    assert overlap(naive(shot(picture, 99)), person_mask()) < 0.85


def test_a_dark_person_is_no_shadow():
    background = room() * 0.5 + 110
    dark = background.copy()
    dark[person_mask()] = (25, 25, 28)
    matte = PlateModel([shot(background, k) for k in range(3)])(shot(dark, 99))
    assert overlap(matte, person_mask()) > 0.95


@pytest.mark.parametrize("gain", [(0.9, 0.9, 0.9), (1.08, 1.0, 0.94)])
def test_changed_exposure_and_white_balance_are_not_the_person(gain):
    model = PlateModel([shot(room(), k) for k in range(3)])
    assert overlap(model(shot(with_person(room()) * gain, 99)), person_mask()) > 0.94


def test_several_plates_tell_where_the_background_flickers():
    flicker = np.zeros((*SIZE, 3))
    flicker[:40, 70:] = 1.0
    plates = [shot(room() + flicker * 25 * (-1) ** k, k) for k in range(6)]
    matte = PlateModel(plates)(shot(with_person(room()) + flicker * 25, 99))
    assert overlap(matte, person_mask()) > 0.94


def test_pieces_beside_the_largest_and_specks_go_and_small_holes_close():
    mask = person_mask()
    spoilt = mask.copy()
    spoilt[5:8, 5:8] = spoilt[60, 80] = True
    spoilt[50, 45] = False
    assert (cleaned(spoilt) == cleaned(mask)).all()
    assert (cleaned(mask) ^ mask).mean() < 0.002
    far = mask.copy()
    far[90:110, 78:88] = True  # a tenth of the person: hidden behind something
    assert cleaned(far)[95, 80]
    assert not cleaned(np.zeros((5, 5), bool)).any()


def test_wrong_plates_are_refused():
    with pytest.raises(InputError, match="at least one"):
        PlateModel([])
    with pytest.raises(InputError, match="all of one size"):
        PlateModel([np.zeros((4, 5, 3), np.uint8), np.zeros((5, 4, 3), np.uint8)])
    with pytest.raises(InputError, match="90 x 120"):
        PlateModel([shot(room(), 0)])(np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(InputError, match="darkest_shadow"):
        PlateConfig(darkest_shadow=1.5)
