"""What a tracker would have made of exact data: parameters, keypoints and label maps with its errors. Seeded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt, gaussian_filter

from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.core.camera import Camera
from smplxpp.core.keypoints import Keypoints2D
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.validation import require_between, require_positive

_NEAR = 0.05  # metres: nothing nearer to a camera is detected
# Confidences of good, hidden and wrong detections: a detector is less sure of what is hidden or wrong, not always.
_SURE, _HIDDEN, _WRONG = (0.6, 1.0), (0.15, 0.55), (0.15, 0.8)
_HIDDEN_NOISE = 2.0
# Scales of a parser's errors as shares of the image's height: of the smooth wandering of borders, of blobs, and how far
# borders wander at most.
_WANDER, _BLOB, _FARTHEST = 0.03, 0.008, 0.06
_BLOB_AREA, _BLOB_REACH, _AMPLITUDES = 0.12, 3.0, 24


@dataclass(frozen=True)
class DetectorConfig:
    """How a detector errs.

    Attributes:
        pixels: standard deviation of a coordinate in an image 640 pixels high; it grows with the height. Twice as much
            for hidden points.
        outliers: share of points that are anywhere in the person's box instead.
        missing: share of points that are not found.

    Raises:
        InputError: shares out of range.
    """

    pixels: float = 3.0
    outliers: float = 0.05
    missing: float = 0.10

    def __post_init__(self) -> None:
        require_positive("pixels", self.pixels)
        for name in ("outliers", "missing"):
            require_between(name, getattr(self, name), 0.0, 1.0)


_REFERENCE_HEIGHT = 640.0


def tracker_noise(
    params: BodyParams,
    *,
    seed: int,
    degrees: float = 1.5,
    transl: float = 0.008,
    expression: float = 0.04,
    betas: float = 0.12,
) -> BodyParams:
    """Return parameters as a tracker would give them; standard deviations of each joint's turn about each axis, of each
    coordinate in metres (half white, half slow), of expression weights, and of one constant offset of betas."""
    rng = np.random.default_rng(seed)
    count = len(params)
    turns = matrix_from_rotvec(rng.normal(0, np.radians(degrees), (count, len(SMPLX_JOINTS), 3)))
    pose = rotvec_from_matrix(turns @ matrix_from_rotvec(params.full_pose))
    phase = rng.uniform(0, 2 * np.pi, 3) + 2 * np.pi * np.arange(count)[:, None] / max(count, 2)
    slow, white = np.sin(phase) * np.sqrt(2), rng.normal(size=(count, 3))
    tracked = BodyParams.from_full_pose(
        pose,
        betas=params.betas + rng.normal(0, betas, params.betas.shape[1]),
        expression=np.clip(params.expression + rng.normal(0, expression, params.expression.shape), 0, 1),
        transl=params.transl + transl * np.sqrt(0.5) * (slow + white),
    )
    return replace(tracked, fps=params.fps, flat_hand_mean=params.flat_hand_mean)


def detector_keypoints(
    points: Float[np.ndarray, "F K 3"],
    camera: Camera,
    *,
    names: Sequence[str],
    frames: Sequence[int],
    seed: int | Sequence[int],
    visible: Bool[np.ndarray, "F K"] | None = None,
    config: DetectorConfig | None = None,
) -> Keypoints2D:
    """What a detector would find of points in the images of a camera.

    Args:
        points: world, metres; of the named points in each frame.
        camera: takes the images; what is outside of them is not found.
        names, frames: of the points' axes.
        seed: of this camera's errors.
        visible: points that nothing hides; hidden ones are found with more noise and less confidence. None: all.
        config: how it errs.
    """
    config = config or DetectorConfig()
    rng = np.random.default_rng(seed)
    shape = (len(frames), len(names))
    screen = camera.screen_from_world(points.reshape(-1, 3)).reshape(*shape, 4)
    size = np.array([camera.width, camera.height], dtype=np.float64)
    with np.errstate(invalid="ignore"):
        inside = (screen[..., 2] > _NEAR) & ((screen[..., :2] >= 0) & (screen[..., :2] <= size)).all(axis=2)
    uv = np.where(inside[..., None], screen[..., :2], 0.0)
    hidden = np.zeros(shape, dtype=bool) if visible is None else ~visible
    noise = config.pixels * camera.height / _REFERENCE_HEIGHT * np.where(hidden, _HIDDEN_NOISE, 1.0)
    found = uv + rng.normal(size=uv.shape) * noise[..., None]
    low = np.where(inside[..., None], uv, np.inf).min(axis=1, keepdims=True)
    high = np.where(inside[..., None], uv, -np.inf).max(axis=1, keepdims=True)
    low, high = np.where(np.isfinite(low), low, 0.0), np.where(np.isfinite(high), high, 0.0)
    wrong = rng.random(shape) < config.outliers
    anywhere = low + rng.random(uv.shape) * (high - low)
    limits = np.where(hidden[..., None], _HIDDEN, _SURE)
    limits = np.where(wrong[..., None], _WRONG, limits)
    confidence = limits[..., 0] + rng.random(shape) * (limits[..., 1] - limits[..., 0])
    gone = (rng.random(shape) < config.missing) | ~inside
    return Keypoints2D(
        tuple(names),
        np.array(frames, dtype=np.int64),
        np.where(wrong[..., None], anywhere, found),
        np.where(gone, 0.0, confidence),
    )


def estimated_labels(
    labels: UInt8[np.ndarray, "H W"],
    *,
    seed: int | Sequence[int],
    share: float = 0.05,
    background: Sequence[int] = (0,),
) -> UInt8[np.ndarray, "H W"]:
    """A label map as a parser would give it: borders between labels wander smoothly, and small blobs beside them are
    wrong.

    The person's outline stays: it comes from the matte. The borders wander as far as makes about `share` of the
    foreground wrong, less where labels have hardly a border.

    Args:
        labels: numbers of any set.
        seed: of this view's errors.
        share: of the foreground's pixels.
        background: numbers of the background.
    """
    foreground = ~np.isin(labels, background)
    if not foreground.any() or (labels[foreground] == labels[foreground][0]).all():
        return labels.copy()
    rng = np.random.default_rng(seed)
    height = labels.shape[0]
    # The labels continued beyond the outline, so that a border that meets it can move there.
    rows, columns = distance_transform_edt(~foreground, return_distances=False, return_indices=True)
    full = labels[rows, columns]
    shift = np.stack([_smooth(rng, labels.shape, _WANDER * height) for _ in range(2)])
    blobs = _smooth(rng, labels.shape, max(_BLOB * height, 1.0))
    shift = shift * np.where(blobs > np.quantile(blobs, 1.0 - _BLOB_AREA), _BLOB_REACH, 1.0)
    # Only the person's pixels change.
    pixels, shift, exact = np.stack(np.nonzero(foreground)), shift[:, foreground], labels[foreground]
    limit = np.array(labels.shape)[:, None] - 1
    best, best_error = exact, np.inf
    for amplitude in np.geomspace(0.25, max(_FARTHEST * height, 0.5), _AMPLITUDES):
        y, x = np.clip(np.round(pixels + amplitude * shift).astype(np.int64), 0, limit)
        moved = full[y, x]
        error = abs(float((moved != exact).mean()) - share)
        if error < best_error:
            best, best_error = moved, error
    out = labels.copy()
    out[foreground] = best
    return out


def _smooth(rng: np.random.Generator, shape: tuple[int, ...], scale: float) -> Float[np.ndarray, "H W"]:
    """Smooth noise of unit size."""
    noise = gaussian_filter(rng.normal(size=shape), scale, mode="reflect")
    return noise / noise.std()
