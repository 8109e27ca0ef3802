"""What colours say of labels: a palette of the scan, histograms on it, and a model of this person's skin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.segment.smoothing import COLOR_STEP

_PALETTE_SIZE, _PALETTE_SAMPLE, _PALETTE_STEPS = 48, 20_000, 12
# Colours this near in OKLab count as one another's: what light, noise and blur do to one dye. Lightness changes most.
_BLUR = COLOR_STEP
_BLUR_SHARE = 0.15  # of a histogram, spread evenly over the palette
# Skin of people in OKLab, any light without a strong tint: hue in degrees, chroma, lightness.
_SKIN_HUE, _SKIN_HUE_SPREAD, _SKIN_CHROMA = 50.0, 22.0, (0.012, 0.16)
_SKIN_LIGHT = (0.2, 0.97)
_LEAST_SPREAD = np.array([0.05, 0.012, 0.012])
_MOST_SPREAD = np.array([0.12, 0.03, 0.03])
# The skin of face and hands differs by less.
_ONE_SKIN = np.array([0.2, 0.04, 0.04])
_FACE_SHARE = 0.25
# Density of colours of things at large, within the colours that a screen can show.
_ANY_COLOR = 10.0
_GREY_SPREAD = 0.012


def has_colors(lab: Float64[np.ndarray, "M 3"]) -> bool:
    """Whether these are colours of a photograph, not one grey for everything."""
    return bool(np.percentile(np.abs(lab - np.median(lab, axis=0)).max(axis=1), 90) > _GREY_SPREAD)


@dataclass(frozen=True, eq=False)
class Palette:
    """A scan's K colours.

    Attributes:
        centers: (K, 3) OKLab. index: (M,) the colour of each face. near: (K, K) how much each counts for each.
    """

    centers: Float64[np.ndarray, "K 3"]
    index: Int64[np.ndarray, " M"]
    near: Float64[np.ndarray, "K K"]

    @staticmethod
    def of(lab: Float64[np.ndarray, "M 3"], *, seed: int = 0) -> Palette:
        """Colours by k-means on a sample (Lloyd, from k-means++ centres); fewer where the scan has fewer."""
        rng = np.random.default_rng(seed)
        sample = lab[rng.permutation(len(lab))[:_PALETTE_SAMPLE]] / _BLUR
        centers = sample[:1]
        squared = ((sample - centers[0]) ** 2).sum(axis=1)
        while len(centers) < _PALETTE_SIZE and squared.max() > 1e-6:
            centers = np.concatenate([centers, sample[rng.choice(len(sample), 1, p=squared / squared.sum())]])
            squared = np.minimum(squared, ((sample - centers[-1]) ** 2).sum(axis=1))
        for _ in range(_PALETTE_STEPS):
            index = cKDTree(centers).query(sample)[1]
            count = np.bincount(index, minlength=len(centers))
            sums = np.stack([np.bincount(index, x, minlength=len(centers)) for x in sample.T], axis=1)
            centers = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], centers)
        near = np.exp(-0.5 * ((centers[:, None] - centers[None]) ** 2).sum(axis=2))
        return Palette(centers * _BLUR, cKDTree(centers).query(lab / _BLUR)[1], near / near.sum(axis=0))

    @property
    def size(self) -> int:
        return len(self.centers)

    def histogram(self, weights: Float64[np.ndarray, " M"]) -> Float64[np.ndarray, " K"]:
        """The share of each colour among faces of these weights, smoothed over colours that are near; sums to 1."""
        counts = np.bincount(self.index, weights, minlength=self.size)
        spread = self.near @ counts
        total = spread.sum()
        even = np.full(self.size, 1.0 / self.size)
        return (1 - _BLUR_SHARE) * (spread / total if total > 0 else even) + _BLUR_SHARE * even


@dataclass(frozen=True, eq=False)
class SkinModel:
    """This person's skin: a normal distribution in OKLab.

    Attributes:
        center, spread: OKLab. found: whether the face or the hands gave it; else it is people's skin at large.
        hands: whether the hands have it (not: gloves, or a face that is covered); None where there are no hands.
    """

    center: Float64[np.ndarray, " 3"]
    spread: Float64[np.ndarray, " 3"]
    found: bool
    hands: bool | None

    def log_ratio(self, lab: Float64[np.ndarray, "M 3"]) -> Float64[np.ndarray, " M"]:
        """log p(colour | this skin) / p(colour | anything), between -4 and 4."""
        z = ((lab - self.center) / self.spread) ** 2
        log_density = -0.5 * z.sum(axis=1) - np.log(self.spread).sum() - 1.5 * np.log(2 * np.pi)
        return np.clip(log_density - np.log(_ANY_COLOR), -4.0, 4.0)


def looks_like_skin(lab: Float64[np.ndarray, "M 3"]) -> Bool[np.ndarray, " M"]:
    """Whether colours are such as some people's skin has; much else has them, too."""
    hue = np.degrees(np.arctan2(lab[:, 2], lab[:, 1]))
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    light = (lab[:, 0] > _SKIN_LIGHT[0]) & (lab[:, 0] < _SKIN_LIGHT[1])
    return (
        light
        & (np.abs(hue - _SKIN_HUE) < 1.6 * _SKIN_HUE_SPREAD)
        & (chroma > _SKIN_CHROMA[0])
        & (chroma < _SKIN_CHROMA[1])
    )


def fit_skin(
    lab: Float64[np.ndarray, "M 3"],
    face: Bool[np.ndarray, " M"],
    hands: Bool[np.ndarray, " M"],
    area: Float64[np.ndarray, " M"],
) -> SkinModel:
    """The skin of face and hands, each asked for its main colour; hands that disagree with the face wear gloves.

    Args:
        face, hands: faces that lie well within these regions of the body.
    """
    of_face, of_hands = _main_color(lab[face], area[face]), _main_color(lab[hands], area[hands])
    agree = False
    if of_face is not None and of_hands is not None:
        # Hair over the face, or a body turned by some degrees: then part of the face alone has the hands' colour.
        like_hands = (np.abs(lab - of_hands[0]) < _ONE_SKIN).all(axis=1)
        agree = bool(area[face & like_hands].sum() > _FACE_SHARE * area[face].sum())
        face = face & like_hands if agree else face
    chosen = (face | hands) if agree else face if of_face is not None else hands
    main = _main_color(lab[chosen], area[chosen]) or of_face or of_hands
    if main is None:
        hue = np.radians(_SKIN_HUE)
        center = np.array([0.65, 0.06 * np.cos(hue), 0.06 * np.sin(hue)])
        return SkinModel(center, np.array([0.2, 0.03, 0.03]), False, None)
    return SkinModel(
        main[0],
        np.clip(main[1], _LEAST_SPREAD, _MOST_SPREAD),
        True,
        None if not hands.any() else agree or of_face is None,
    )


def _main_color(lab: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Centre and spread of the skin-like colours, without the outer ones; None where a third of the area has none."""
    skin = looks_like_skin(lab)
    if len(lab) < 10 or area[skin].sum() < 0.33 * area.sum():
        return None
    lab = lab[skin]
    # The densest place, then the mean of what is around it.
    sample = lab[:: max(1, len(lab) // 500)] / COLOR_STEP
    near = cKDTree(sample).query_ball_point(sample, 1.5, return_length=True)
    center = sample[int(near.argmax())] * COLOR_STEP
    for _ in range(5):
        spread = np.clip(1.4826 * np.median(np.abs(lab - center), axis=0), _LEAST_SPREAD, _MOST_SPREAD)
        near = (np.abs(lab - center) < 2.5 * spread).all(axis=1)
        if not near.any():
            break
        center = lab[near].mean(axis=0)
    return center, 1.15 * lab[near].std(axis=0) if near.any() else spread
