"""Play a template along a motion: what loose clothes follow of it, and its surface with them simulated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import ceil

import numpy as np
from jaxtyping import Float

from smplxpp.cloth.driver import ClothDriver, DriverConfig
from smplxpp.cloth.garment import Garment
from smplxpp.cloth.poses import resampled, smoothed
from smplxpp.cloth.quality import ClothQuality
from smplxpp.core import BodyParams, require_positive
from smplxpp.template.template import Template

SLOWEST = 40.0
"""Poses a second at least that clothes follow: places that go straight from pose to pose cut the corners of limbs."""
SMOOTHING = 0.03
"""Standard deviation of the Gaussian in time, seconds: trackers shake waistbands."""


def followed(poses: BodyParams, fps: float, *, smoothing: float = SMOOTHING) -> tuple[BodyParams, int]:
    """Return an even motion without leaps as clothes follow it, and how many of its poses a frame has.

    Frame k is pose k times that number.

    Args:
        poses: T frames.
        fps: of them.
        smoothing: seconds; 0: none.
    """
    poses = smoothed(poses, radius=smoothing * fps)
    times, last = max(1, ceil(SLOWEST / fps - 1e-6)), len(poses) - 1
    if times > 1:
        steps = np.arange(times * last + 1.0) / times
        poses = resampled(poses, np.arange(last + 1.0), np.minimum(steps, last))
    return poses, times


def ways(
    params: BodyParams, fps: float, *, smoothing: float = SMOOTHING, leap: float = DriverConfig.teleport
) -> Iterator[list[BodyParams]]:
    """Yield for every frame the poses that lead to it from the one before, even in time, it (smoothed) the last.

    Args:
        params: T frames, evenly spaced.
        fps: of them.
        smoothing: seconds; 0: none.
        leap: metres a second of the root; what is faster is a cut, over which nothing is smoothed.

    Raises:
        InputError: no frames a second.
    """
    require_positive("frames a second", fps)
    speeds = fps * np.linalg.norm(np.diff(params.transl, axis=0), axis=1)
    for stretch in np.split(np.arange(len(params)), np.flatnonzero(speeds > leap) + 1):
        poses, times = followed(params.select(stretch), fps, smoothing=smoothing)
        yield [poses.frame(0)]
        for k in range(times, len(poses), times):
            yield [poses.frame(at) for at in range(k - times + 1, k + 1)]


def play(
    template: Template,
    garments: Sequence[Garment],
    params: BodyParams,
    *,
    fps: float,
    config: DriverConfig | None = None,
    smoothing: float = SMOOTHING,
    notes: list[str] | None = None,
    quality: list[ClothQuality] | None = None,
) -> Iterator[Float[np.ndarray, "V 3"]]:
    """Yield the posed surface of every frame, metres; the clothes start cold before the first one.

    Args:
        params: T frames, evenly spaced.
        fps: of them.
        config: of the driver.
        smoothing: of what the clothes follow (`smplxpp.cloth.play`), seconds.
        notes: list to which the remarks of the driver are added.
        quality: list whose content becomes what was measured of each garment in the frames until then.
    """
    driver = ClothDriver(template, garments, config)
    weights = template.weights.dense()
    count = template.body.vertex_count
    for k, poses in enumerate(ways(params, fps, smoothing=smoothing)):
        frame = params.frame(k)
        posed = template.posed_body(frame)
        shape = driver.follow(poses, 1.0 / fps, frame, posed=posed)
        # Cloth is displaced at rest and then skinned: v = sum_j w_j G_j (rest + share displacement). The body's rest
        # vertices bring shape, expression and pose correctives.
        rest = template.vertices.copy()
        rest[:count] = posed.rest_vertices[0]
        rest[shape.vertices] += shape.share[:, None] * shape.displacements
        blended = (weights @ posed.posed_from_rest[0, :, :3].reshape(-1, 12)).reshape(-1, 3, 4)
        if notes is not None:
            notes += driver.notes[len(notes) :]
        if quality is not None:
            quality[:] = driver.quality
        yield np.einsum("vij,vj->vi", blended[:, :, :3], rest) + blended[:, :, 3]
