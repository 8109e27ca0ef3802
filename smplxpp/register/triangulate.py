"""Triangulate keypoints of several cameras robustly, and note the faults that were found in them.

1. Consensus: every pair of cameras proposes each point; the proposal with the least truncated cost wins (MSAC).
2. Faults: exchanged sides, wrong calibrations and other people are found against the other cameras (from four cameras
   on) and mended or dropped; the points are triangulated again after each.
3. Refinement: Gauss-Newton on the reprojection errors with Cauchy weights, alternating with an estimate of each
   camera's pixel noise, three times. The covariance of a point is the inverse of its normal matrix.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.core import Camera, InputError, Keypoints2D, require_at_least, require_positive
from smplxpp.core.errors import one_line
from smplxpp.register.keypoint_faults import (
    Table,
    find_camera_fault,
    find_other_people,
    find_swapped,
    mirror_index,
    number_ranges,
    pose_difference,
)
from smplxpp.register.multiview import Sightings, all_pairs, consensus, pixel_noise, refine, resection

# Alternations of mending and triangulating, and of refining and estimating the noise; both settle within three.
_ROUNDS = 3


@dataclass(frozen=True)
class TriangulationConfig:
    """Options of a triangulation of keypoints from several views.

    Attributes:
        threshold: largest reprojection error of an inlier, as a share of the image's height.
        threshold_metres: the same in metres at the person's distance; the larger one counts, because a close-up
            magnifies the errors of a detector.
        least_confidence: confidence below which a sighting is ignored.
        least_degrees: smallest angle between the rays of a pair of cameras that may propose a point.
        most_pairs: number of pairs above which a random choice of this size proposes.
        seed: of that choice.
        diagnose: whether to search for exchanged sides, other people and wrong calibrations.
    """

    threshold: float = 0.02
    threshold_metres: float = 0.035
    least_confidence: float = 0.05
    least_degrees: float = 3.0
    most_pairs: int = 400
    seed: int = 0
    diagnose: bool = True

    def __post_init__(self) -> None:
        for name in ("threshold", "threshold_metres", "least_degrees"):
            require_positive(name, getattr(self, name))
        require_at_least("most_pairs", self.most_pairs, 1)


@dataclass(frozen=True)
class Reprojection:
    """Reprojection errors of some sightings.

    Attributes:
        median_px: median over the inliers, pixels; NaN without any.
        p95_px: 95 % quantile over the inliers.
        inliers: number of inliers.
        count: number of all sightings.
    """

    median_px: float
    p95_px: float
    inliers: int
    count: int


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Triangulated points with their uncertainty.

    Attributes:
        names: of the K points.
        frames: numbers of the F frames.
        cameras: names of the C cameras.
        points: in world coordinates, metres; NaN where fewer than two cameras, or fewer than a third of those that see
            the point, agree.
        covariance: of the points from the pixel noise alone, square metres; NaN where the point is.
        inliers: whether a sighting agrees with the point.
        noise_px: standard deviation of a coordinate in each camera's pixels, estimated from the residuals.
        by_camera: reprojection errors of each camera.
        by_point: reprojection errors of each named point.
        keypoints: the keypoints that were used, with mended sides, without dropped cameras and views.
        left_out: names of the cameras that were dropped.
        notes: sentences about the faults and what was done about them.
    """

    names: tuple[str, ...]
    frames: tuple[int, ...]
    cameras: tuple[str, ...]
    points: Float64[np.ndarray, "F K 3"]
    covariance: Float64[np.ndarray, "F K 3 3"]
    inliers: Bool[np.ndarray, "F K C"]
    noise_px: Mapping[str, float]
    by_camera: Mapping[str, Reprojection]
    by_point: Mapping[str, Reprojection]
    keypoints: Mapping[str, Keypoints2D]
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    __repr__ = one_line

    @property
    def sigma(self) -> Float64[np.ndarray, "F K"]:
        """The standard deviation of a coordinate, metres, which is the root of the covariance's mean diagonal."""
        return np.sqrt(np.trace(self.covariance, axis1=2, axis2=3) / 3.0)


def triangulate(
    keypoints: Mapping[str, Keypoints2D],
    cameras: Mapping[str, Camera],
    *,
    names: Sequence[str] | None = None,
    frames: Sequence[int] | None = None,
    config: TriangulationConfig | None = None,
) -> Triangulation:
    """Triangulate the named points of all frames.

    From four cameras on, faults are searched for: views with left and right exchanged are mended, views of another
    person are dropped, and cameras with a wrong calibration are dropped and noted with the correction that resection
    against the other cameras' points finds. Frames in which fewer than two cameras see the person have no points.

    A fault that all cameras share cannot be found: if every view has its sides exchanged, the result is a mirrored
    person, and only a body that is fitted to it shows the fault.

    Args:
        keypoints: by camera, in the pixels of `cameras`.
        cameras: by name; those without keypoints are ignored.
        names: of the points; None for all that any camera has.
        frames: numbers; None for all that any camera has.
        config: options.

    Raises:
        InputError: keypoints of fewer than two cameras, or of a camera that is not given.
    """
    config = config or TriangulationConfig()
    table, notes = _table(keypoints, cameras, names, frames, config)
    # Consensus twice: its depths turn the threshold in metres into pixels, with which it is repeated.
    table = _with_thresholds(table, _proposed(table, config), config)
    table, points, faults, left_out = (
        _mended(table, config) if config.diagnose else (table, _proposed(table, config), [], [])
    )
    # Refinement and noise depend on each other, because the noise decides which sightings are inliers.
    s = table.sightings
    unit = _unit(table, cameras, config)
    for _ in range(_ROUNDS):
        refined, _, inliers = refine(s, points)
        s = replace(s, noise=pixel_noise(s, refined, inliers, unit=unit))
    points, covariance, inliers = refine(s, points)
    return _result(replace(table, sightings=s), points, covariance, inliers, left_out, [*notes, *faults])


def _table(
    keypoints: Mapping[str, Keypoints2D],
    cameras: Mapping[str, Camera],
    names: Sequence[str] | None,
    frames: Sequence[int] | None,
    config: TriangulationConfig,
) -> tuple[Table, list[str]]:
    """Arrange the sightings as a table, with notes about frames that fewer than two cameras see."""
    unknown = sorted(set(keypoints) - set(cameras))
    used = tuple(name for name in cameras if name in keypoints)
    if unknown or len(used) < 2:
        raise InputError(
            "keypoints to triangulate",
            expected="keypoints of at least two calibrated cameras",
            received=f"those of {', '.join(unknown)}, not calibrated" if unknown else f"{len(used)} cameras",
        )
    if names is None:
        names = tuple(dict.fromkeys(name for camera in used for name in keypoints[camera].names))
    if frames is None:
        frames = sorted({int(frame) for camera in used for frame in keypoints[camera].frames})
    # Arrays over cameras, frames and points; weights below the least confidence are 0.
    chosen = [keypoints[camera].select(names, frames) for camera in used]
    weight = np.stack([one.confidence for one in chosen])
    weight = np.where(weight >= config.least_confidence, weight, 0.0)
    pixels = np.stack([one.points for one in chosen])
    own = [cameras[name] for name in used]
    threshold = config.threshold * np.array([float(camera.height) for camera in own])
    flat = (len(used), len(frames) * len(names))
    sightings = Sightings.of(own, pixels.reshape(*flat, 2), weight.reshape(flat), threshold=threshold)
    seen = ((weight > 0).sum(axis=2) > 0).sum(axis=0)
    empty = [frame for frame, count in zip(frames, seen, strict=True) if count < 2]
    notes = [f"frame {number_ranges(empty)}: fewer than two cameras see the person; no points"] if empty else []
    return Table(sightings, tuple(names), tuple(int(f) for f in frames), used), notes


def _unit(table: Table, cameras: Mapping[str, Camera], config: TriangulationConfig) -> Float64[np.ndarray, " C"]:
    """Return the order of magnitude of a detector's noise, in each camera's pixels: a quarter of the threshold."""
    return 0.25 * config.threshold * np.array([float(cameras[name].height) for name in table.cameras])


def _with_thresholds(table: Table, points: Float64[np.ndarray, "N 3"], config: TriangulationConfig) -> Table:
    """Raise each camera's threshold to what the threshold in metres is in its pixels at the person's depth."""
    s = table.sightings
    known = (s.weight > 0) & np.isfinite(points).all(axis=1)
    threshold = s.threshold.copy()
    for k, pose in enumerate(s.cam_from_world):
        depth = points[known[k]] @ pose[2, :3] + pose[2, 3]
        if (depth > 0).any():
            # Pixels a metre at the median depth: the geometric mean of the focal lengths over the depth.
            scale = np.sqrt(abs(np.linalg.det(s.K[k, :2, :2]))) / float(np.median(depth[depth > 0]))
            threshold[k] = max(threshold[k], config.threshold_metres * scale)
    return replace(table, sightings=replace(s, threshold=threshold))


def _proposed(table: Table, config: TriangulationConfig) -> Float64[np.ndarray, "N 3"]:
    """Return the consensus of pairs of cameras."""
    pairs = all_pairs(len(table.cameras), most=config.most_pairs, seed=config.seed)
    return consensus(table.sightings, pairs, least_degrees=config.least_degrees)


def _mended(
    table: Table, config: TriangulationConfig
) -> tuple[Table, Float64[np.ndarray, "N 3"], list[str], list[str]]:
    """Mend or drop faulty views; return the table, its points, notes about the faults, and the dropped cameras."""
    points = _proposed(table, config)
    least_cameras = 4  # among fewer, it cannot be decided which one is wrong
    swapped = np.zeros((len(table.cameras), len(table.frames)), dtype=bool)
    left_out: list[str] = []
    faults: list[str] = []
    if len(table.cameras) < least_cameras:
        return table, points, [], []
    # 1. Exchanged sides: mend them and triangulate again, since the mended views support other points.
    refined = refine(table.sightings, points)[0]
    for _ in range(_ROUNDS):
        found = find_swapped(table, refined)
        if not found.any():
            break
        swapped ^= found
        table = _exchanged(table, found)
        points = _proposed(table, config)
        refined = refine(table.sightings, points)[0]
    notes = [_swap_note(table, k, row) for k, row in enumerate(swapped) if row.any()]
    # 2. Faulty cameras: drop the worst one and triangulate again, until none contradicts the rest.
    names = list(table.cameras)
    while len(names) - len(left_out) >= least_cameras:
        fault = find_camera_fault(table, refined)
        if fault is None:
            break
        camera, misplaced = fault
        left_out.append(names[camera])
        given = table.sightings
        table = _without(table, np.arange(len(names)) == camera, np.ones(len(table.frames), dtype=bool))
        points = _proposed(table, config)
        refined = refine(table.sightings, points)[0]
        if misplaced:  # measured against points that it had no part in
            turn, shift = pose_difference(given.cam_from_world[camera], resection(given, camera, refined).pose)
            move = f" and move by {1e3 * shift:.0f} mm" if shift > 1e-3 else ""
            faults.append(
                f"camera {names[camera]}: its calibration is off: it would have to turn by {turn:.1f} degrees{move} to "
                "agree with the others; left out"
            )
        else:
            faults.append(f"camera {names[camera]}: its keypoints are of another person; left out")
    # 3. Views of another person in single frames.
    others = find_other_people(table, refined)
    if others.any():
        for k in np.flatnonzero(others.any(axis=1)):
            numbers = [frame for frame, other in zip(table.frames, others[k], strict=True) if other]
            faults.append(f"camera {names[k]}, frame {number_ranges(numbers)}: keypoints of another person; left out")
            table = _without(table, np.arange(len(names)) == k, others[k])
        points = _proposed(table, config)
    return table, points, [*notes, *faults], left_out


def _swap_note(table: Table, camera: int, row: Bool[np.ndarray, " F"]) -> str:
    numbers = [frame for frame, swapped in zip(table.frames, row, strict=True) if swapped]
    where = "the whole view" if row.all() else f"frame {number_ranges(numbers)}"
    return f"camera {table.cameras[camera]}: left and right are swapped in {where}; swapped back"


def _exchanged(table: Table, swapped: Bool[np.ndarray, "C F"]) -> Table:
    """Exchange left and right in some views; points whose counterpart is missing count as not seen."""
    s, mirror = table.sightings, mirror_index(table.names)
    pixels, weight = table.by_frame(s.pixels).copy(), table.by_frame(s.weight).copy()
    source = np.where(mirror < 0, 0, mirror)
    pixels[swapped] = pixels[swapped][:, source]
    weight[swapped] = np.where(mirror < 0, 0.0, weight[swapped][:, source])
    return replace(
        table, sightings=replace(s, pixels=pixels.reshape(s.pixels.shape), weight=weight.reshape(s.weight.shape))
    )


def _without(table: Table, cameras: Bool[np.ndarray, " C"], frames: Bool[np.ndarray, " F"]) -> Table:
    """Remove all sightings of some views."""
    weight = table.by_frame(table.sightings.weight).copy()
    weight[np.ix_(cameras, frames)] = 0.0
    return replace(table, sightings=replace(table.sightings, weight=weight.reshape(table.sightings.weight.shape)))


def _result(
    table: Table,
    points: Float64[np.ndarray, "N 3"],
    covariance: Float64[np.ndarray, "N 3 3"],
    inliers: Bool[np.ndarray, "C N"],
    left_out: Sequence[str],
    notes: Sequence[str],
) -> Triangulation:
    """Summarise the reprojection errors and reshape all arrays to frames and points."""
    s, shape = table.sightings, (len(table.frames), len(table.names))
    length = table.by_frame(np.linalg.norm(s.residuals(points), axis=2))
    agree, seen = table.by_frame(inliers), table.by_frame(s.weight > 0)

    def summary(where: tuple) -> Reprojection:
        own = length[where][agree[where]]
        median, high = np.percentile(own, [50, 95]) if len(own) else (np.nan, np.nan)
        return Reprojection(float(median), float(high), len(own), int(seen[where].sum()))

    pixels, weight = table.by_frame(s.pixels), table.by_frame(s.weight)
    frames = np.array(table.frames, dtype=np.int64)
    return Triangulation(
        names=table.names,
        frames=table.frames,
        cameras=table.cameras,
        points=points.reshape(*shape, 3),
        covariance=covariance.reshape(*shape, 3, 3),
        inliers=np.moveaxis(agree, 0, -1),
        noise_px=dict(zip(table.cameras, s.noise.tolist(), strict=True)),
        by_camera={name: summary((k,)) for k, name in enumerate(table.cameras)},
        by_point={name: summary((slice(None), slice(None), k)) for k, name in enumerate(table.names)},
        keypoints={
            name: Keypoints2D(table.names, frames, pixels[k], weight[k])
            for k, name in enumerate(table.cameras)
            if name not in left_out
        },
        left_out=tuple(left_out),
        notes=tuple(notes),
    )
