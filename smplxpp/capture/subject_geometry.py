"""Match the people of all views of a frame to people in space, by the distances between rays to their keypoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.capture.calibrations.world import focus_of
from smplxpp.capture.distortion import Distortion
from smplxpp.capture.keypoint_people import Person
from smplxpp.core import Camera

# Distance of two rays of one point, metres: detectors' points are off by centimetres, calibrations of phones by more.
_SAME_POINT = 0.10
# Points that two views of a person have to share.
_LEAST_SHARED = 5
# Rays that meet at less than this angle do not tell a place.
_LEAST_DEGREES = 3.0
# Size of a person: distance of two points that 90 % of the pairs do not exceed, metres.
_SMALLEST, _LARGEST = 0.25, 2.4


@dataclass(frozen=True, eq=False)
class Sighted:
    """People of all views of a frame, as rays.

    Attributes:
        camera: index of each one's camera.
        origin: position of that camera, metres.
        rays: unit vectors to the K points.
        weight: confidence of the points, 0 where they are not seen.
    """

    camera: Int64[np.ndarray, " D"]
    origin: Float64[np.ndarray, "D 3"]
    rays: Float64[np.ndarray, "D K 3"]
    weight: Float64[np.ndarray, "D K"]

    def __len__(self) -> int:
        return len(self.camera)


@dataclass(frozen=True, eq=False)
class PersonInSpace:
    """A person that at least two views agree on.

    Attributes:
        members: rows of `Sighted`, one a camera at most.
        points: the K points, metres; NaN where fewer than two views see one.
    """

    members: tuple[int, ...]
    points: Float64[np.ndarray, "K 3"]

    @property
    def centre(self) -> Float64[np.ndarray, " 3"]:
        """Median of the points that are known, metres."""
        return np.median(self.points[np.isfinite(self.points).all(axis=1)], axis=0)


def people_in_space(seen: Sighted) -> list[PersonInSpace]:
    """Group the people of all views into people in space, those that most views agree on first.

    A pair of views proposes a person; every other camera joins with its person whose rays pass nearest, if their median
    distance is below 10 cm. The proposal with the most views wins, of equals the one with the smallest distances; its
    views are taken out, and the next is looked for.
    """
    most_seeds = 20  # pairs of views that are tried as the start of a person
    clearly_seen = 0.75  # share of all cameras from which a person needs no better proposal
    free = np.ones(len(seen), dtype=bool)
    found: list[PersonInSpace] = []
    pairs = _pairs(seen)
    while True:
        seeds = [pair for pair in pairs if free[pair[1]] and free[pair[2]]][:most_seeds]
        best: tuple[PersonInSpace, float] | None = None
        for _, i, j in seeds:
            # A pair that is part of the best person already would propose it again.
            if best is not None and {i, j} <= set(best[0].members):
                continue
            one = _grown(seen, (i, j), free)
            if one is not None and len(one[0].members) > clearly_seen * len(np.unique(seen.camera)):
                best = one
                break
            if one is not None and (best is None or (len(one[0].members), -one[1]) > (len(best[0].members), -best[1])):
                best = one
        if best is None:
            return found
        found.append(best[0])
        free[list(best[0].members)] = False


def distances(seen: Sighted, row: int, points: Float64[np.ndarray, "K 3"]) -> Float64[np.ndarray, " K"]:
    """Return the distances of a person's rays from points in space, metres; NaN for points that either lacks.

    Points behind the camera are infinitely far.
    """
    offset = points - seen.origin[row]
    along = np.einsum("kx,kx->k", offset, seen.rays[row])
    away = np.linalg.norm(offset - along[:, None] * seen.rays[row], axis=1)
    away = np.where(along > 0, away, np.inf)
    return np.where((seen.weight[row] > 0) & np.isfinite(points).all(axis=1), away, np.nan)


def typical_distance(seen: Sighted, row: int, points: Float64[np.ndarray, "K 3"]) -> float:
    """Return the median of `distances`; infinite where fewer than five points are known."""
    away = distances(seen, row, points)
    known = away[~np.isnan(away)]
    return float(np.median(known)) if len(known) >= _LEAST_SHARED else np.inf


def met_points(seen: Sighted, rows: Sequence[int]) -> Float64[np.ndarray, "K 3"]:
    """Return the points nearest to the rays of some people, by least squares; NaN where fewer than two rays are, or
    where all are almost parallel."""
    rays, weight = seen.rays[list(rows)], seen.weight[list(rows)]
    across = (np.eye(3) - rays[..., :, None] * rays[..., None, :]) * weight[..., None, None]
    normal = across.sum(axis=0)
    right = np.einsum("mkxy,my->kx", across, seen.origin[list(rows)])
    # The smallest eigenvalue is that of a pair of rays at the least angle: 1 - cos for two of weight one.
    seen_by = (weight > 0).sum(axis=0)
    least = np.linalg.eigvalsh(normal)[:, 0] / np.maximum(weight.max(axis=0), 1e-9)
    good = (seen_by >= 2) & (least > 0.1 * (1.0 - np.cos(np.radians(_LEAST_DEGREES))))
    points = np.full((rays.shape[1], 3), np.nan)
    points[good] = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
    return points


def _pairs(seen: Sighted) -> list[tuple[float, int, int]]:
    """Return pairs of people of two cameras whose rays meet, with their median distance, the nearest first.

    Two rays `o + s d` and `p + t e` are nearest at `s = (c f - g) / (1 - c^2)`, `t = (f - c g) / (1 - c^2)` with
    `c = d . e`, `f = e . (o - p)`, `g = d . (o - p)`.
    """
    first, second = np.array([p for p in combinations(range(len(seen)), 2)], dtype=np.int64).reshape(-1, 2).T
    across = seen.camera[first] != seen.camera[second]
    first, second = first[across], second[across]
    d, e = seen.rays[first], seen.rays[second]
    both = (seen.weight[first] > 0) & (seen.weight[second] > 0)
    apart = (seen.origin[first] - seen.origin[second])[:, None]
    cosine, f, g = (np.einsum("nkx,nkx->nk", *np.broadcast_arrays(*pair)) for pair in ((d, e), (apart, e), (apart, d)))
    sine = 1.0 - cosine**2
    usable = both & (sine > np.sin(np.radians(_LEAST_DEGREES)) ** 2)
    sine = np.where(usable, sine, 1.0)
    s, t = (cosine * f - g) / sine, (f - cosine * g) / sine
    gap = np.linalg.norm(apart + s[..., None] * d - t[..., None] * e, axis=2)
    gap = np.where((s > 0) & (t > 0), gap, np.inf)
    out = []
    for n in np.flatnonzero(usable.sum(axis=1) >= _LEAST_SHARED):
        cost = float(np.median(gap[n, usable[n]]))
        if cost < _SAME_POINT:
            out.append((cost, int(first[n]), int(second[n])))
    return sorted(out)


def _grown(seen: Sighted, pair: tuple[int, int], free: Bool[np.ndarray, " D"]) -> tuple[PersonInSpace, float] | None:
    """Return the person that a pair proposes, with the views that agree, and the mean of their median distances."""
    members, points = list(pair), met_points(seen, pair)
    for camera in np.unique(seen.camera[free]):
        if camera in seen.camera[members]:
            continue
        rows = np.flatnonzero(free & (seen.camera == camera))
        costs = [typical_distance(seen, int(row), points) for row in rows]
        if min(costs) < _SAME_POINT:
            members.append(int(rows[int(np.argmin(costs))]))
            points = met_points(seen, members)
    costs = [typical_distance(seen, row, points) for row in members]
    kept = [row for row, cost in zip(members, costs, strict=True) if cost < _SAME_POINT]
    if len(kept) < 2:
        return None
    points = met_points(seen, kept)
    if not _is_person(points):
        return None
    return PersonInSpace(tuple(sorted(kept)), points), float(np.mean([typical_distance(seen, r, points) for r in kept]))


def _is_person(points: Float64[np.ndarray, "K 3"]) -> bool:
    """Tell whether the known points are as far apart as those of a person."""
    known = points[np.isfinite(points).all(axis=1)]
    if len(known) < _LEAST_SHARED:
        return False
    size = float(np.percentile(np.linalg.norm(known[:, None] - known[None], axis=2), 90))
    return _SMALLEST < size < _LARGEST


# Points that are compared: the body's and the feet's. Fingers and points of the face are many and small.
_PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe", "heel", "nose", "eye", "ear")
_LEAST_CONFIDENCE = 0.05


@dataclass(frozen=True, eq=False)
class Views:
    """People of all views as rays, and where they are in the files.

    Attributes:
        names: of the cameras.
        sighted: people of each frame.
        place: index of each of them in its list, by frame.
        height: of each in its image, a share of the image's height, by frame.
        points: pixels of the seen points of each, by frame.
        focus: point that the cameras look at, metres.
        reach: median distance of the cameras from it.
    """

    names: tuple[str, ...]
    sighted: Mapping[int, Sighted]
    place: Mapping[int, list[int]]
    height: Mapping[int, list[float]]
    points: Mapping[int, list[Float64[np.ndarray, "n 2"]]]
    focus: Float64[np.ndarray, " 3"]
    reach: float

    @staticmethod
    def of(
        people: Mapping[str, Mapping[int, Sequence[Person]]],
        cameras: Mapping[str, Camera],
        distortions: Mapping[str, Distortion],
        frames: Sequence[int],
    ) -> Views:
        """Collect the people of some frames.

        Args:
            people: by camera and frame, in pixels of the images on disk.
            cameras: full cameras of the undistorted images; those that are compared.
            distortions: of distorted images.
            frames: numbers.
        """
        # One row a person of a view: camera, frame, place in its list.
        listed = [
            (c, frame, k, one)
            for c, name in enumerate(cameras)
            for frame, own in people[name].items()
            for k, one in enumerate(own)
        ]
        camera_of = np.array([c for c, *_ in listed], dtype=np.int64)
        table = _table([one for *_, one in listed])
        # Rays camera by camera: undistortion takes all points of a lens at once.
        rays, origin = np.zeros((*table.shape[:2], 3)), np.zeros((len(listed), 3))
        for c, (name, camera) in enumerate(cameras.items()):
            rows = np.flatnonzero(camera_of == c)
            rays[rows], shown = _rays(table[rows], camera, distortions.get(name))
            table[rows, :, 2] = np.where(shown, table[rows, :, 2], 0.0)
            origin[rows] = camera.position
        rows_of: dict[int, list[int]] = {frame: [] for frame in frames}
        for row, (_, frame, _, _) in enumerate(listed):
            rows_of[frame].append(row)
        heights = [camera.height for camera in cameras.values()]
        sizes = [_height(one) / heights[c] for c, one in zip(camera_of.tolist(), table, strict=True)]
        centres = np.stack([camera.position for camera in cameras.values()])
        focus = focus_of(centres, np.stack([camera.cam_from_world[2, :3] for camera in cameras.values()]))
        return Views(
            names=tuple(cameras),
            sighted={f: Sighted(camera_of[r], origin[r], rays[r], table[r, :, 2]) for f, r in rows_of.items()},
            place={f: [listed[row][2] for row in r] for f, r in rows_of.items()},
            height={f: [sizes[row] for row in r] for f, r in rows_of.items()},
            points={f: [table[row][table[row, :, 2] > 0, :2] for row in r] for f, r in rows_of.items()},
            focus=focus,
            reach=float(np.median(np.linalg.norm(centres - focus, axis=1))),
        )


def _table(people: Sequence[Person]) -> Float64[np.ndarray, "D K 3"]:
    """Return u, v, confidence of the compared points that anybody has; 0 where a point is missing or unsure."""
    names = dict.fromkeys(
        name for one in people for name in one.points if "face" not in name and any(part in name for part in _PARTS)
    )
    table = np.zeros((len(people), len(names), 3))
    for row, one in enumerate(people):
        for column, name in enumerate(names):
            table[row, column] = one.points.get(name, 0.0)
    table[table[..., 2] < _LEAST_CONFIDENCE] = 0.0
    return table


def _rays(
    table: Float64[np.ndarray, "D K 3"], camera: Camera, distortion: Distortion | None
) -> tuple[Float64[np.ndarray, "D K 3"], np.ndarray]:
    """Return unit vectors of the world to the points of one camera, and which points the lens shows."""
    detected = table[..., 2] > 0
    plane = (table[detected][:, :2] - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    if distortion is not None:
        plane = distortion.undistort(plane)
    known = np.isfinite(plane).all(axis=1)
    inside = np.concatenate([np.where(known[:, None], plane, 0.0), np.ones((len(plane), 1))], axis=1)
    inside = inside @ camera.cam_from_world[:3, :3]
    rays, shown = np.zeros(table.shape), detected.copy()
    rays[detected] = inside / np.linalg.norm(inside, axis=1, keepdims=True)
    shown[detected] = known
    return rays, shown


def _height(points: Float64[np.ndarray, "K 3"]) -> float:
    """Return the height in pixels of the seen points; 0 for fewer than two."""
    seen = points[points[:, 2] > 0]
    return float(np.ptp(seen[:, 1])) if len(seen) > 1 else 0.0
