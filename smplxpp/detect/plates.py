"""Masks where the rig was photographed empty: what differs from the empty plates, and is no shadow on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float32, UInt8

from smplxpp.core.errors import InputError
from smplxpp.core.validation import require_at_least, require_between, require_positive

# Holes of at most this share of the largest piece are filled: larger ones are between an arm and the body.
_HOLE = 0.002
# Share of a neighbourhood that has to be the person for its colour to count.
_LEAST_SHARE = 0.02
# Exposure: pixels of the blur that takes the noise out, how many pixels vote and propose, what counts as one ratio, and
# the largest change that is believed.
_GAIN_BLUR, _GAIN_VOTERS, _GAIN_PROPOSALS, _SAME_GAIN, _MOST_GAIN = 2.0, 10_000, 200, 0.02, 1.3


@dataclass(frozen=True)
class PlateConfig:
    """How a photograph is told from the empty plate.

    Attributes:
        least_noise: standard deviation of a value of 255 that a camera has at least; one plate alone tells none.
        threshold: deviations from which a pixel is the person for sure.
        weak: share of the threshold from which a pixel is the person if it hangs on one that is for sure.
        darkest_shadow: share of a plate's light that is left in a shadow; what is darker is the person.
        shadow_colour: deviations of colour, brightness set aside, that a shadow may have.
        blur: pixels, of the differences: noise is averaged and thin gaps are closed.
        edge: pixels about the outline in which the matte is soft.
        least_share: of the largest piece, from which another piece of the person is kept (a foot behind a chair).
    """

    least_noise: float = 2.5
    threshold: float = 6.0
    weak: float = 0.5
    darkest_shadow: float = 0.5
    shadow_colour: float = 6.0
    blur: float = 1.0
    edge: int = 2
    least_share: float = 0.05

    def __post_init__(self) -> None:
        for name in ("least_noise", "threshold", "shadow_colour"):
            require_positive(name, getattr(self, name))
        for name in ("weak", "darkest_shadow", "least_share"):
            require_between(name, getattr(self, name), 0.0, 1.0)
        for name in ("blur", "edge"):
            require_at_least(name, getattr(self, name), 0)


class PlateModel:
    """The empty background of one camera: the median of its plates and the noise about it.

    A person who is in front of a background of their own colour cannot be told from it.

    Raises:
        InputError: no plates, or plates of several sizes.
    """

    def __init__(self, plates: Sequence[UInt8[np.ndarray, "H W 3"]], config: PlateConfig | None = None) -> None:
        shapes = {plate.shape for plate in plates}
        if len(shapes) != 1:
            raise InputError(
                "empty plates of a camera",
                expected="at least one, all of one size",
                received=", ".join(str(shape) for shape in sorted(shapes)) or "none",
            )
        self.config = config or PlateConfig()
        stack = np.stack(plates).astype(np.float32)
        self._mean: Float32[np.ndarray, "H W 3"] = np.median(stack, axis=0)
        # 1.4826 of the median distance is a normal's deviation; few plates tell it badly, so neighbours share theirs.
        spread = 1.4826 * np.median(np.abs(stack - self._mean), axis=0)
        spread = np.sqrt(scipy.ndimage.uniform_filter(np.square(spread).mean(axis=2), 9, mode="nearest"))
        self._noise: Float32[np.ndarray, "H W"] = np.maximum(spread, self.config.least_noise).astype(np.float32)

    def __call__(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
        """The opacity of whatever stands in front of the background.

        Raises:
            InputError: a photograph of another size than the plates.
        """
        if image.shape != self._mean.shape:
            raise InputError(
                "photograph beside its empty plate",
                expected=f"{self._mean.shape[1]} x {self._mean.shape[0]} pixels",
                received=f"{image.shape[1]} x {image.shape[0]}",
            )
        config = self.config
        shown = image.astype(np.float32) / self._gain(image)
        score, changed = self._deviations(shown)
        sure, weak = score > 1.0, score > config.weak
        pieces, _ = scipy.ndimage.label(weak, structure=np.ones((3, 3)))
        kept = np.isin(pieces, np.unique(pieces[sure & weak])) & weak
        person = cleaned(kept, least_share=config.least_share)
        # Clothes of a shadow's colour leave holes in which nothing is the plate's; behind an arm it is.
        person |= _changed_holes(person, changed > 1.0)
        return np.round(255.0 * self._opacity(shown, person)).astype(np.uint8)

    def _opacity(
        self, image: Float32[np.ndarray, "H W 3"], person: Bool[np.ndarray, "H W"]
    ) -> Float32[np.ndarray, "H W"]:
        """The matte: near the outline, how far a pixel is from the plate towards the person's colour inside.

        With I the image, B the plate and F the mean of what is surely the person nearby,
        `a = (I - B) . (F - B) / |F - B|^2`. Where F is too near B, or nothing inside is near, the outline stays hard.
        """
        out = person.astype(np.float32)
        if not self.config.edge or not person.any():
            return out
        inner = scipy.ndimage.binary_erosion(person, iterations=self.config.edge)
        band = scipy.ndimage.binary_dilation(person) & ~inner
        share = scipy.ndimage.gaussian_filter(inner.astype(np.float32), self.config.edge)
        near = (
            np.stack(
                [scipy.ndimage.gaussian_filter(image[..., k] * inner, self.config.edge) for k in range(3)], axis=-1
            )
            / np.maximum(share, _LEAST_SHARE)[..., None]
        )
        apart = near - self._mean
        length = (apart * apart).sum(axis=2)
        alpha = ((image - self._mean) * apart).sum(axis=2) / np.maximum(length, 1.0)
        told = band & (share > _LEAST_SHARE) & (length > np.square(2.0 * self.config.threshold * self._noise))
        out[told] = np.clip(alpha[told], 0.0, 1.0)
        return out

    def _gain(self, image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, " 3"]:
        """What exposure and white balance have changed since the plate: of the ratios that some pixel proposes the one
        that most pixels agree with. A person may fill most of the image: what covers the plate has no common ratio.
        """
        blur = (_GAIN_BLUR, _GAIN_BLUR, 0)
        shown, plate = (scipy.ndimage.gaussian_filter(x.astype(np.float32), blur) for x in (image, self._mean))
        usable = ((plate > 16) & (plate < 240) & (shown < 250)).all(axis=2)
        ratios = (shown[usable] / plate[usable]).astype(np.float32)
        ratios = ratios[((ratios > 1 / _MOST_GAIN) & (ratios < _MOST_GAIN)).all(axis=1)]
        if not len(ratios):
            return np.ones(3, dtype=np.float32)
        rng = np.random.default_rng(0)
        voters = ratios[rng.permutation(len(ratios))[:_GAIN_VOTERS]]
        proposals = np.concatenate([np.ones((1, 3), dtype=np.float32), voters[:_GAIN_PROPOSALS]])
        votes = np.array([(np.abs(voters / one - 1.0) < _SAME_GAIN).all(axis=1).sum() for one in proposals])
        best = proposals[votes.argmax()]
        return np.median(voters[(np.abs(voters / best - 1.0) < _SAME_GAIN).all(axis=1)], axis=0)

    def _deviations(
        self, image: Float32[np.ndarray, "H W 3"]
    ) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
        """How far pixels are from the background and any shadow on it, and from the background alone, in units of the
        thresholds.

        The image is split as Horprasert et al. (1999) do: a pixel is the plate's colour times a brightness, and what is
        left is colour. A brightness between `darkest_shadow` and 1 with little colour left is a shadow.
        """
        config, mean = self.config, self._mean
        if config.blur:
            image, mean = (scipy.ndimage.gaussian_filter(one, (config.blur, config.blur, 0)) for one in (image, mean))
        square = np.maximum((mean * mean).sum(axis=2), 1.0)
        brightness = (image * mean).sum(axis=2) / square
        colour = np.linalg.norm(image - brightness[..., None] * mean, axis=2) / self._noise
        length = np.linalg.norm(image - mean, axis=2) / self._noise
        # Dark plates have no colour to compare: a shadow on them is within the noise anyhow.
        lit = (brightness <= 1.0) & (brightness >= config.darkest_shadow)
        changed = (length / config.threshold).astype(np.float32)
        score = np.where(lit, np.minimum(colour / config.shadow_colour, changed), changed)
        return score.astype(np.float32), changed


def cleaned(person: Bool[np.ndarray, "H W"], *, least_share: float = 0.05) -> Bool[np.ndarray, "H W"]:
    """The largest piece of a mask and others at least `least_share` of it, without specks, small holes filled."""
    opened = scipy.ndimage.binary_opening(person, structure=np.ones((3, 3)))
    pieces, count = scipy.ndimage.label(opened)
    if not count:
        return np.zeros_like(person)
    sizes = np.bincount(pieces.ravel())[1:]
    kept = np.isin(pieces, 1 + np.flatnonzero(sizes >= max(least_share, 1e-9) * sizes.max()))
    closed = scipy.ndimage.binary_closing(np.pad(kept, 2))[2:-2, 2:-2] | kept
    return closed | _small_holes(closed, int(_HOLE * sizes.max()))


def _small_holes(mask: Bool[np.ndarray, "H W"], most: int) -> Bool[np.ndarray, "H W"]:
    """Holes of at most so many pixels."""
    holes, _ = scipy.ndimage.label(~mask)
    sizes = np.bincount(holes.ravel())
    small = np.flatnonzero(sizes <= most)
    return np.isin(holes, small[small > 0])


def _changed_holes(mask: Bool[np.ndarray, "H W"], changed: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Holes of which most pixels are not the plate's."""
    outside = ~scipy.ndimage.binary_fill_holes(mask)
    holes, count = scipy.ndimage.label(~mask & ~outside)
    if not count:
        return np.zeros_like(mask)
    share = scipy.ndimage.mean(changed, holes, np.arange(1, count + 1))
    return np.isin(holes, 1 + np.flatnonzero(share > 0.5))
