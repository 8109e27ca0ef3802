"""Made rooms to put the people of captures on black before, and photographs of them."""

from __future__ import annotations

import numpy as np
import scipy.ndimage
from jaxtyping import Float64, UInt8

from smplxpp.capture import Capture


def made_room(size: tuple[int, int], *, seed: int) -> Float64[np.ndarray, "H W 3"]:
    """A wall with soft patches, panels and a floor."""
    width, height = size
    rng = np.random.default_rng(seed)
    soft = scipy.ndimage.gaussian_filter(rng.normal(size=(height, width, 3)), (height / 9, width / 9, 0))
    room = 130 + 45 * soft / soft.std() + rng.uniform(-25, 25, 3)
    for x in rng.integers(0, width, 4):
        room[:, x : x + width // 12] += rng.uniform(-40, 40)
    room[int(0.8 * height) :] *= 0.8
    return np.clip(room, 25, 235)


def person_before(
    room: Float64[np.ndarray, "H W 3"], capture: Capture, camera: str, frame: int
) -> Float64[np.ndarray, "H W 3"]:
    """The person before a room, with a shadow about the feet and a slightly other exposure than the plate's."""
    colour, alpha = capture.foreground(camera, frame)
    opacity = alpha[..., None] / 255.0
    rows, columns = np.nonzero(alpha > 127)
    y, x = np.mgrid[: len(alpha), : alpha.shape[1]]
    wide, low = np.ptp(columns), rows.max()
    shadow = np.exp(-(((x - columns.mean() - 0.2 * wide) / (0.5 * wide)) ** 2 + ((y - low) / (0.05 * len(alpha))) ** 2))
    shaded = room * (1.0 - 0.4 * shadow[..., None])
    return 0.96 * (colour + (1.0 - opacity) * shaded)


def photograph_of(clean: Float64[np.ndarray, "H W 3"], *, seed: int) -> UInt8[np.ndarray, "H W 3"]:
    """A photograph with the noise of a camera indoors."""
    noise = np.random.default_rng(seed).normal(0.0, 4.0, clean.shape)
    return np.clip(clean + noise, 0, 255).astype(np.uint8)
