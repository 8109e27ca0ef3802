"""Segment a person against photographs of the empty rig: what differs from these plates and is no shadow on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float32, UInt8

from smplxpp.core import InputError, require_at_least, require_between, require_positive


@dataclass(frozen=True)
class PlateConfig:
    """Options of the segmentation against empty plates.

    Attributes:
        least_noise: lower bound of a pixel's standard deviation, in grey levels of 255; a single plate shows none.
        threshold: standard deviations from which a pixel belongs to the person.
        weak: share of the threshold from which a pixel belongs to the person if it is connected to one that exceeds the
            threshold (hysteresis).
        darkest_shadow: smallest share of a plate's light that a shadow leaves; darker pixels belong to the person.
        shadow_colour: standard deviations by which the chromaticity of a shadow may differ from the plate's.
        blur: standard deviation of the Gaussian blur, pixels, which averages noise and closes thin gaps.
        edge: width of the soft outline, pixels.
        least_share: size relative to the largest component, from which another one is kept (a foot behind a chair).
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
    """The background model of one camera: the median of its empty plates and the noise around it.

    A person cannot be distinguished from a background of the same colour.

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
        # 1.4826 times the median absolute deviation is a Gaussian's standard deviation; few plates estimate it badly,
        # so it is averaged over 9 x 9 pixels.
        spread = 1.4826 * np.median(np.abs(stack - self._mean), axis=0)
        spread = np.sqrt(scipy.ndimage.uniform_filter(np.square(spread).mean(axis=2), 9, mode="nearest"))
        self._noise: Float32[np.ndarray, "H W"] = np.maximum(spread, self.config.least_noise).astype(np.float32)

    def __call__(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
        """Return the opacity of whatever stands in front of the background.

        Raises:
            InputError: a photograph of another size than the plates.
        """
        if image.shape != self._mean.shape:
            raise InputError(
                "photograph beside its empty plate",
                expected=f"{self._mean.shape[1]} x {self._mean.shape[0]} pixels",
                received=f"{image.shape[1]} x {image.shape[0]}",
            )
        # Hysteresis threshold: connected components of weak pixels that contain a strong one.
        config = self.config
        shown = image.astype(np.float32) / self._gain(image)
        score, changed = self._deviations(shown)
        strong, weak = score > 1.0, score > config.weak
        pieces, _ = scipy.ndimage.label(weak, structure=np.ones((3, 3)))
        kept = np.isin(pieces, np.unique(pieces[strong & weak])) & weak
        person = cleaned(kept, least_share=config.least_share)
        # Cloth of a shadow's colour leaves holes in which nothing looks like the plate, unlike the gap beside an arm.
        person |= _changed_holes(person, changed > 1.0)
        return np.round(255.0 * self._opacity(shown, person)).astype(np.uint8)

    def _opacity(
        self, image: Float32[np.ndarray, "H W 3"], person: Bool[np.ndarray, "H W"]
    ) -> Float32[np.ndarray, "H W"]:
        """Return the matte: near the outline, the projection of a pixel onto the line from plate to foreground colour.

        With I the image, B the plate and F the mean colour of the person's inside nearby, the opacity is
        `a = (I - B) . (F - B) / |F - B|^2`. Where F is too near to B, or no inside is near, the outline stays hard.
        """
        least_inside = 0.02  # share of a neighbourhood that must be inside for its mean colour to count
        out = person.astype(np.float32)
        if not self.config.edge or not person.any():
            return out
        # The band around the outline, and the local mean colour of the eroded inside.
        inner = scipy.ndimage.binary_erosion(person, iterations=self.config.edge)
        band = scipy.ndimage.binary_dilation(person) & ~inner
        share = scipy.ndimage.gaussian_filter(inner.astype(np.float32), self.config.edge)
        near = (
            np.stack(
                [scipy.ndimage.gaussian_filter(image[..., k] * inner, self.config.edge) for k in range(3)], axis=-1
            )
            / np.maximum(share, least_inside)[..., None]
        )
        apart = near - self._mean
        length = (apart * apart).sum(axis=2)
        alpha = ((image - self._mean) * apart).sum(axis=2) / np.maximum(length, 1.0)
        known = band & (share > least_inside) & (length > np.square(2.0 * self.config.threshold * self._noise))
        out[known] = np.clip(alpha[known], 0.0, 1.0)
        return out

    def _gain(self, image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, " 3"]:
        """Estimate the change of exposure and white balance since the plate by a consensus over pixels (RANSAC).

        Pixels propose the ratio of their colours to the plate's, and the ratio with which most pixels agree within 2 %
        wins. The person may fill most of the image, because pixels that cover the plate have no common ratio.
        """
        # Blur against noise, then drop pixels that are too dark, saturated, or changed by more than 1.3.
        most_gain, same_gain = 1.3, 0.02
        blur = (2.0, 2.0, 0)
        shown, plate = (scipy.ndimage.gaussian_filter(x.astype(np.float32), blur) for x in (image, self._mean))
        usable = ((plate > 16) & (plate < 240) & (shown < 250)).all(axis=2)
        ratios = (shown[usable] / plate[usable]).astype(np.float32)
        ratios = ratios[((ratios > 1 / most_gain) & (ratios < most_gain)).all(axis=1)]
        if not len(ratios):
            return np.ones(3, dtype=np.float32)
        # 10,000 random pixels vote on no change and on the ratios of the first 200 of them.
        rng = np.random.default_rng(0)
        voters = ratios[rng.permutation(len(ratios))[:10_000]]
        proposals = np.concatenate([np.ones((1, 3), dtype=np.float32), voters[:200]])
        votes = np.array([(np.abs(voters / one - 1.0) < same_gain).all(axis=1).sum() for one in proposals])
        best = proposals[votes.argmax()]
        return np.median(voters[(np.abs(voters / best - 1.0) < same_gain).all(axis=1)], axis=0)

    def _deviations(
        self, image: Float32[np.ndarray, "H W 3"]
    ) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
        """Return the distances of pixels from the background with any shadow on it, and without, in thresholds.

        After Horprasert et al. (1999), a pixel is the plate's colour times a brightness, plus a rest that is its
        difference of chromaticity. A brightness between `darkest_shadow` and 1 with a small rest is a shadow.
        """
        config, mean = self.config, self._mean
        if config.blur:
            image, mean = (scipy.ndimage.gaussian_filter(one, (config.blur, config.blur, 0)) for one in (image, mean))
        square = np.maximum((mean * mean).sum(axis=2), 1.0)
        brightness = (image * mean).sum(axis=2) / square
        colour = np.linalg.norm(image - brightness[..., None] * mean, axis=2) / self._noise
        length = np.linalg.norm(image - mean, axis=2) / self._noise
        # On dark plates the brightness is unreliable, but there a shadow is within the noise.
        lit = (brightness <= 1.0) & (brightness >= config.darkest_shadow)
        changed = (length / config.threshold).astype(np.float32)
        score = np.where(lit, np.minimum(colour / config.shadow_colour, changed), changed)
        return score.astype(np.float32), changed


def cleaned(person: Bool[np.ndarray, "H W"], *, least_share: float = 0.05) -> Bool[np.ndarray, "H W"]:
    """Keep a mask's largest component and others of at least `least_share` of it, without specks and small holes.

    Holes of up to 0.2 % of the largest component are filled; larger ones are gaps between an arm and the body.
    """
    opened = scipy.ndimage.binary_opening(person, structure=np.ones((3, 3)))
    pieces, count = scipy.ndimage.label(opened)
    if not count:
        return np.zeros_like(person)
    sizes = np.bincount(pieces.ravel())[1:]
    kept = np.isin(pieces, 1 + np.flatnonzero(sizes >= max(least_share, 1e-9) * sizes.max()))
    closed = scipy.ndimage.binary_closing(np.pad(kept, 2))[2:-2, 2:-2] | kept
    return closed | _small_holes(closed, int(0.002 * sizes.max()))


def _small_holes(mask: Bool[np.ndarray, "H W"], most: int) -> Bool[np.ndarray, "H W"]:
    """Return the holes of a mask that have at most `most` pixels."""
    holes, _ = scipy.ndimage.label(~mask)
    sizes = np.bincount(holes.ravel())
    small = np.flatnonzero(sizes <= most)
    return np.isin(holes, small[small > 0])


def _changed_holes(mask: Bool[np.ndarray, "H W"], changed: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Return the holes of a mask in which most pixels differ from the plate."""
    outside = ~scipy.ndimage.binary_fill_holes(mask)
    holes, count = scipy.ndimage.label(~mask & ~outside)
    if not count:
        return np.zeros_like(mask)
    share = scipy.ndimage.mean(changed, holes, np.arange(1, count + 1))
    return np.isin(holes, 1 + np.flatnonzero(share > 0.5))
