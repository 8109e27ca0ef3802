"""Keypoints of several cameras to points in space, robustly, with what was wrong with them in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError
from smplxpp.core.keypoints import Keypoints2D
from smplxpp.core.validation import require_at_least, require_positive
from smplxpp.register.keypoint_faults import (
    Table,
    find_camera_fault,
    find_other_people,
    find_swapped,
    in_words,
    mirror_index,
    pose_difference,
)
from smplxpp.register.multiview import Sightings, all_pairs, consensus, pixel_noise, refine, resection

# With fewer cameras nobody can say which of them is wrong.
_LEAST_TO_JUDGE = 4
_ROUNDS = 3


@dataclass(frozen=True)
class TriangulationConfig:
    """How points are triangulated.

    Attributes:
        threshold: pixels that a sighting may be off, as a share of the image's height.
        threshold_metres: the same at the person's distance; the larger counts (a close-up shows errors larger).
        least_confidence: of a sighting that counts.
        least_degrees: between the rays of a pair of cameras that may propose a point.
        most_pairs: of cameras that propose; beyond, so many of them at random.
        seed: of that choice.
        diagnose: look for swapped sides, other people and misplaced cameras, and mend or leave out what is found.
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
    """How far sightings are from the points' projections.

    Attributes:
        median_px, p95_px: over the inliers; NaN without any.
        inliers, count: sightings that count, and all.
    """

    median_px: float
    p95_px: float
    inliers: int
    count: int


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Points in space.

    Attributes:
        names, frames, cameras: of the tables' axes.
        points: world, metres; NaN where fewer than two cameras agree, or fewer than a third of those that see it.
        covariance: square metres, of the pixels' noise alone; NaN where the point is.
        inliers: sightings that agree with the point.
        noise_px: standard deviation of a coordinate in each camera's pixels, estimated from the residuals.
        by_camera, by_point: reprojection.
        keypoints: what was used: sides swapped back, without the cameras that were left out and the views of others.
        left_out: cameras that were.
        problems: what was wrong and what was done about it.
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
    problems: tuple[str, ...] = ()

    @property
    def sigma(self) -> Float64[np.ndarray, "F K"]:
        """Standard deviation of a coordinate, metres: the root of the covariance's mean diagonal."""
        return np.sqrt(np.trace(self.covariance, axis1=2, axis2=3) / 3.0)


def triangulate(
    keypoints: Mapping[str, Keypoints2D],
    cameras: Mapping[str, Camera],
    *,
    names: Sequence[str] | None = None,
    frames: Sequence[int] | None = None,
    config: TriangulationConfig | None = None,
) -> Triangulation:
    """Triangulate named points of all frames.

    Every point is proposed by pairs of cameras, the proposal that most cameras agree with is refined by least squares
    of the reprojection. Then, from four cameras on, what contradicts the majority is looked for: views with left and
    right exchanged (exchanged back), views of somebody else (left out), cameras that stand elsewhere than their
    calibration says (named with the angle that resection against the others' points gives, and left out). Frames in
    which fewer than two cameras see the person are named and have no points.

    What all cameras agree on cannot be told from the truth: if every view has its sides exchanged, the points are those
    of a mirrored person, and only a body that is fitted to them shows it.

    Args:
        keypoints: by camera, in the pixels of `cameras`.
        cameras: by name; those without keypoints are not used.
        names: of points; None: all that any camera has.
        frames: None: all that any camera has.
        config: see there.

    Raises:
        InputError: keypoints of fewer than two cameras, or of a camera that is not given.
    """
    config = config or TriangulationConfig()
    table, problems = _table(keypoints, cameras, names, frames, config)
    table = _with_thresholds(table, _first(table, config), config)
    table, points, told, left_out = (
        _judged(table, config) if config.diagnose else (table, _first(table, config), [], [])
    )
    s = table.sightings
    unit = _unit(table, cameras, config)
    for _ in range(_ROUNDS):
        refined, _, inliers = refine(s, points)
        s = replace(s, noise=pixel_noise(s, refined, inliers, unit=unit))
    points, covariance, inliers = refine(s, points)
    return _result(replace(table, sightings=s), points, covariance, inliers, left_out, [*problems, *told])


def _table(
    keypoints: Mapping[str, Keypoints2D],
    cameras: Mapping[str, Camera],
    names: Sequence[str] | None,
    frames: Sequence[int] | None,
    config: TriangulationConfig,
) -> tuple[Table, list[str]]:
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
    problems = [f"frame {in_words(empty)}: fewer than two cameras see the person; no points"] if empty else []
    return Table(sightings, tuple(names), tuple(int(f) for f in frames), used), problems


def _unit(table: Table, cameras: Mapping[str, Camera], config: TriangulationConfig) -> Float64[np.ndarray, " C"]:
    """What a detector's noise is of the order of, in each camera's pixels."""
    return 0.25 * config.threshold * np.array([float(cameras[name].height) for name in table.cameras])


def _with_thresholds(table: Table, points: Float64[np.ndarray, "N 3"], config: TriangulationConfig) -> Table:
    """The table with what a sighting may be off at the distance of what each camera sees."""
    s = table.sightings
    known = (s.weight > 0) & np.isfinite(points).all(axis=1)
    threshold = s.threshold.copy()
    for k, pose in enumerate(s.cam_from_world):
        depth = points[known[k]] @ pose[2, :3] + pose[2, 3]
        if (depth > 0).any():
            scale = np.sqrt(abs(np.linalg.det(s.K[k, :2, :2]))) / float(np.median(depth[depth > 0]))
            threshold[k] = max(threshold[k], config.threshold_metres * scale)
    return replace(table, sightings=replace(s, threshold=threshold))


def _first(table: Table, config: TriangulationConfig) -> Float64[np.ndarray, "N 3"]:
    pairs = all_pairs(len(table.cameras), most=config.most_pairs, seed=config.seed)
    return consensus(table.sightings, pairs, least_degrees=config.least_degrees)


def _judged(
    table: Table, config: TriangulationConfig
) -> tuple[Table, Float64[np.ndarray, "N 3"], list[str], list[str]]:
    """The table without what others contradict, its first points, what was found, and the cameras left out."""
    points = _first(table, config)
    swapped = np.zeros((len(table.cameras), len(table.frames)), dtype=bool)
    left_out: list[str] = []
    elsewhere: list[str] = []
    if len(table.cameras) < _LEAST_TO_JUDGE:
        return table, points, [], []
    refined = refine(table.sightings, points)[0]
    for _ in range(_ROUNDS):
        found = find_swapped(table, refined)
        if not found.any():
            break
        swapped ^= found
        table = _exchanged(table, found)
        points = _first(table, config)
        refined = refine(table.sightings, points)[0]
    problems = [_swap_words(table, k, row) for k, row in enumerate(swapped) if row.any()]
    names = list(table.cameras)
    while len(names) - len(left_out) >= _LEAST_TO_JUDGE:
        fault = find_camera_fault(table, refined)
        if fault is None:
            break
        camera, misplaced = fault
        left_out.append(names[camera])
        given = table.sightings
        table = _without(table, np.arange(len(names)) == camera, np.ones(len(table.frames), dtype=bool))
        points = _first(table, config)
        refined = refine(table.sightings, points)[0]
        if misplaced:  # by how much: against points that it has no part in
            turn, shift = pose_difference(given.cam_from_world[camera], resection(given, camera, refined).pose)
            move = f" and move by {1e3 * shift:.0f} mm" if shift > 1e-3 else ""
            elsewhere.append(
                f"camera {names[camera]}: its calibration is off: it would have to turn by {turn:.1f} degrees{move} to "
                "agree with the others; left out"
            )
        else:
            elsewhere.append(f"camera {names[camera]}: its keypoints are of another person; left out")
    others = find_other_people(table, refined)
    if others.any():
        for k in np.flatnonzero(others.any(axis=1)):
            numbers = [frame for frame, other in zip(table.frames, others[k], strict=True) if other]
            elsewhere.append(f"camera {names[k]}, frame {in_words(numbers)}: keypoints of another person; left out")
            table = _without(table, np.arange(len(names)) == k, others[k])
        points = _first(table, config)
    return table, points, [*problems, *elsewhere], left_out


def _swap_words(table: Table, camera: int, row: Bool[np.ndarray, " F"]) -> str:
    numbers = [frame for frame, swapped in zip(table.frames, row, strict=True) if swapped]
    where = "the whole view" if row.all() else f"frame {in_words(numbers)}"
    return f"camera {table.cameras[camera]}: left and right are swapped in {where}; swapped back"


def _exchanged(table: Table, swapped: Bool[np.ndarray, "C F"]) -> Table:
    """The table with left and right of some views exchanged; what has no other side among the names is not seen."""
    s, mirror = table.sightings, mirror_index(table.names)
    pixels, weight = table.by_frame(s.pixels).copy(), table.by_frame(s.weight).copy()
    source = np.where(mirror < 0, 0, mirror)
    pixels[swapped] = pixels[swapped][:, source]
    weight[swapped] = np.where(mirror < 0, 0.0, weight[swapped][:, source])
    return replace(
        table, sightings=replace(s, pixels=pixels.reshape(s.pixels.shape), weight=weight.reshape(s.weight.shape))
    )


def _without(table: Table, cameras: Bool[np.ndarray, " C"], frames: Bool[np.ndarray, " F"]) -> Table:
    """The table with nothing seen in some views."""
    weight = table.by_frame(table.sightings.weight).copy()
    weight[np.ix_(cameras, frames)] = 0.0
    return replace(table, sightings=replace(table.sightings, weight=weight.reshape(table.sightings.weight.shape)))


def _result(
    table: Table,
    points: Float64[np.ndarray, "N 3"],
    covariance: Float64[np.ndarray, "N 3 3"],
    inliers: Bool[np.ndarray, "C N"],
    left_out: Sequence[str],
    problems: Sequence[str],
) -> Triangulation:
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
        problems=tuple(problems),
    )
