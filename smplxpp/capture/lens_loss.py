"""What a wide lens showed and the pinhole that replaces it does not."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from smplxpp.capture.distortion import Distortion, RationalDistortion
from smplxpp.capture.recording import Problem
from smplxpp.core.camera import Camera

_GRID = 64
# Losses below this share are margins; every undistortion has them.
_LEAST_SHARE = 0.05


def lost_share(camera: Camera, distortion: Distortion) -> float:
    """The share, from 0 to 1, of a distorted picture that lies outside of `camera`'s undistorted one."""
    middles = (np.arange(_GRID) + 0.5) / _GRID
    x, y = np.meshgrid(middles * camera.width, middles * camera.height)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    K, size = camera.K, (camera.width, camera.height)
    with np.errstate(over="ignore", invalid="ignore"):  # principal points far away
        seen = distortion.undistort((pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T) @ K[:2, :2].T + K[:2, 2]
    return float(1.0 - ((seen >= 0) & (seen <= size)).all(axis=1).mean())  # NaN is outside


def lens_problems(cameras: Mapping[str, Camera], distortions: Mapping[str, Distortion]) -> list[Problem]:
    """Say which fisheye lenses lose more than their margins to the pinhole that keeps their focal length and size."""
    alike: dict[tuple, list[str]] = {}
    for name, distortion in distortions.items():
        if name in cameras and not isinstance(distortion, RationalDistortion):
            camera = cameras[name]
            key = (distortion, camera.K.tobytes(), camera.width, camera.height)
            alike.setdefault(key, []).append(name)
    found = []
    for (distortion, *_), names in alike.items():
        share = lost_share(cameras[names[0]], distortion)
        if share >= _LEAST_SHARE:
            shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
            found.append(Problem(f"camera {shown}: {share:.0%} of the picture is outside of the undistorted one"))
    return found
