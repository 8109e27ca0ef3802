"""Find landmarks of a bare scan: draw it from all around, detect keypoints in the pictures, triangulate them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

from smplxpp.core import InputError, Keypoints2D, ProgressCallback, TriangleMesh, ignore_progress, require_at_least
from smplxpp.detect import Detector
from smplxpp.raster import ShadeStyle, render_shaded, turntable_cameras
from smplxpp.register import Triangulation, TriangulationConfig, triangulate

Landmarks = dict[str, tuple[Float64[np.ndarray, " 3"], float]]
_SEEN = 0.3
"""Confidence from which a view counts as one that sees a point."""


@dataclass(frozen=True)
class ScanViews:
    """How a scan is drawn for a detector of keypoints.

    Attributes:
        count: number of pictures, on one turn about the scan's upright axis.
        height: of a picture, pixels.
        relief: strength of light and shadow over a scan with colours. It is low because the surface's noise shows in
            it; without colours it is 1, because shading is all there is to see.
        least_views: number of views that have to agree on a point.
    """

    count: int = 12
    height: int = 720
    relief: float = 0.3
    least_views: int = 3

    def __post_init__(self) -> None:
        require_at_least("scan views: count", self.count, 3)
        require_at_least("scan views: height", self.height, 64)
        require_at_least("scan views: least_views", self.least_views, 2)


def keypoints_of_scan(
    mesh: TriangleMesh,
    colors: UInt8[np.ndarray, "V 3"] | None,
    detector: Detector,
    *,
    config: ScanViews | None = None,
    progress: ProgressCallback = ignore_progress,
) -> Landmarks:
    """Find the landmarks that a detector knows on a scan that stands upright.

    Args:
        mesh: metres, +Y up; it may have any facing.
        colors: sRGB; None: drawn as grey clay.
        detector: see `smplxpp.detect`.
        config: how it is drawn.
        progress: called with the share of the pictures that are drawn.

    Returns:
        By name the point in the scan's space and a confidence from 0 to 1: the detector's own mean, times the share of
        the views that agree among those that saw the point.

    Raises:
        InputError: no person in the pictures, or no point that several of them agree on.
    """
    config = config or ScanViews()
    seen = views_of_scan(mesh, colors, detector, config, progress=progress)
    landmarks = _landmarks(seen, config)
    if not landmarks:
        raise InputError(
            "scan",
            expected="a person whose keypoints its pictures agree on",
            received="points that no two pictures agree on",
            remedy="check that it stands upright (--up), or place landmarks by hand",
        )
    return landmarks


def views_of_scan(
    mesh: TriangleMesh,
    colors: UInt8[np.ndarray, "V 3"] | None,
    detector: Detector,
    config: ScanViews,
    *,
    progress: ProgressCallback = ignore_progress,
) -> Triangulation:
    """Triangulate what the detector sees in pictures from all around, as one frame.

    Raises:
        InputError: fewer than two pictures with a person in them.
    """
    # Vertices that no face uses may lie anywhere and would widen the frame of the pictures.
    used = mesh.vertices[np.unique(mesh.faces)]
    # Middle grey: neither light nor dark hair and clothes vanish before it.
    style = ShadeStyle(background=(128, 128, 128), relief=1.0 if colors is None else config.relief)
    # The cameras stand on a circle around the vertical axis. The detector was trained on upright people.
    keypoints, cameras = {}, {}
    for k, camera in enumerate(turntable_cameras(used, count=config.count, height=config.height)):
        people = detector(render_shaded(mesh, camera, vertex_colors=colors, style=style))
        # The first person is the most confident one; a scan holds one person.
        if people:
            name = f"view {k}"
            cameras[name] = camera
            keypoints[name] = Keypoints2D(
                # One frame with number 0: (1, K, 2) points and (1, K) confidences.
                detector.names,
                np.array([0]),
                people[0].points[None],
                people[0].confidence[None],
            )
        progress("views", (k + 1) / config.count)
    # Two rays are the least that intersect in a point.
    if len(cameras) < 2:
        raise InputError(
            "scan",
            expected="a person who is found in pictures of it",
            received=f"one in {len(cameras)} of {config.count} pictures",
            remedy="check that it stands upright (--up), or place landmarks by hand",
        )
    return triangulate(keypoints, cameras, config=TriangulationConfig(least_confidence=_SEEN))


def facing(landmarks: Mapping[str, tuple[Float64[np.ndarray, " 3"], float]]) -> Float64[np.ndarray, " 3"] | None:
    """Return the horizontal unit vector to the person's front, from shoulders, hips, eyes and ears; None without any.

    With up +Y and the left side at +X the front is at +Z.
    """
    across = np.zeros(3)
    # Lines from right to left are summed, so that wider pairs count more.
    for pair in ("coco_{}_shoulder", "coco_{}_hip", "{}_eye", "{}_ear"):
        left, right = (landmarks.get(pair.format(side)) for side in ("left", "right"))
        if left is not None and right is not None:
            across += left[0] - right[0]
    # The vector from right to left, turned by -90 degrees about +Y: (x, 0, z) -> (-z, 0, x). Left +X gives +Z.
    front = np.array([-across[2], 0.0, across[0]])
    length = float(np.linalg.norm(front))
    return front / length if length > 0 else None


def _landmarks(seen: Triangulation, config: ScanViews) -> Landmarks:
    # (V, K): the confidence of each view for each landmark.
    weights = np.stack([seen.keypoints[name].confidence[0] for name in seen.cameras if name in seen.keypoints])
    rows = [k for k, name in enumerate(seen.cameras) if name in seen.keypoints]
    # RANSAC's inliers (K, V of all cameras), restricted to views with detections; a view of zero confidence does not
    # vote.
    agree = seen.inliers[0][:, rows].T & (weights > 0)
    out: Landmarks = {}
    for k, name in enumerate(seen.names):
        count = int(agree[:, k].sum())
        # A point that few views agree on is dropped: two wrong detections may intersect by chance.
        if count < config.least_views or not np.isfinite(seen.points[0, k]).all():
            continue
        # Mean confidence of the views that agree, times the share of agreeing views among those that see the point.
        certainty = weights[agree[:, k], k].mean() * count / max((weights[:, k] >= _SEEN).sum(), count)
        out[name] = (seen.points[0, k], float(np.clip(certainty, 0.0, 1.0)))
    return out
