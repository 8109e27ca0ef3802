"""Choose whose keypoints are a capture's: one person over all cameras and frames, where others are in view.

1. In each frame the people of all views are grouped into people in space (`people_in_space`).
2. These are followed from frame to frame, each to the nearest place.
3. The subject is the one with the greatest product of: share of views that agree on it, size in the images, nearness to
   the middle of what the cameras look at, and, where there are masks, the share of its points inside them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64
from scipy.optimize import linear_sum_assignment

from smplxpp.capture.calibrations.world import focus_of
from smplxpp.capture.distortion import Distortion
from smplxpp.capture.keypoint_files import joined, read_people
from smplxpp.capture.keypoint_people import Person, chosen_person
from smplxpp.capture.keypoint_places import KeypointFiles
from smplxpp.capture.subject_geometry import PersonInSpace, Sighted, people_in_space, typical_distance
from smplxpp.core import Camera, InputError, Keypoints2D

MaskReader = Callable[[str, int], "np.ndarray | None"]
"""Reads the mask of a camera and a frame as (H, W) opacity of the image on disk; None without one."""

# Points that are compared: the body's and the feet's. Fingers and faces are many and small.
_PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe", "heel", "nose", "eye", "ear")
_LEAST_CONFIDENCE = 0.05
# A person moves at most so far between two frames, metres, and is taken up again within the larger one after a gap.
_STEP, _REACH = 0.6, 2.0
# Distance of rays, metres, up to which a view joins a person known from the other views or frames.
_JOINS = 0.35
# Share of a person's frames below which a camera that never agrees counts as misplaced: its nearest person is kept.
_DISAGREES = 0.1
_MASKED_FRAMES = 5  # frames whose masks are read
_NAMED = 4  # people that a note describes


@dataclass(frozen=True, eq=False)
class Track:
    """A person over the frames.

    Attributes:
        places: the person in space by frame.
        score: see the module's docstring.
        views: share of the views that agree on it.
    """

    places: Mapping[int, PersonInSpace]
    score: float = 0.0
    views: float = 0.0

    def centre(self) -> Float64[np.ndarray, " 3"]:
        """Median position over the frames, metres."""
        return np.median([place.centre for place in self.places.values()], axis=0)


@dataclass(frozen=True, eq=False)
class SubjectKeypoints:
    """Keypoints of one person, chosen over all cameras and frames; a `KeypointSource`.

    Attributes:
        files: files of all people.
        rig: full cameras of the undistorted images.
        distortions: of the cameras whose images, and keypoints, are distorted.
        subject: place of the person in the order of preference, from 1; None: 1.
        mask: reads masks, None without any.
    """

    files: KeypointFiles
    rig: Mapping[str, Camera]
    distortions: Mapping[str, Distortion] = field(default_factory=dict)
    subject: int | None = None
    mask: MaskReader | None = None

    def cameras(self) -> tuple[str, ...]:
        """Return the names of the cameras with keypoints."""
        return self.files.cameras()

    def frames(self) -> tuple[int, ...]:
        """Return the frames with keypoints."""
        return self.files.frames()

    def read(self, camera: str) -> Keypoints2D | None:
        """Read the subject's keypoints of a camera, None without any.

        Raises:
            InputError: a damaged file, or a `subject` that nobody is.
        """
        if camera not in self._chosen[0]:
            return self.files.read(camera)
        return joined(self._chosen[0][camera], self.files.options.first_frame)

    def notes(self) -> tuple[str, ...]:
        """Return sentences about the people in view and who was taken."""
        return self._chosen[1]

    @cached_property
    def _chosen(self) -> tuple[dict[str, dict[int, Person | None]], tuple[str, ...]]:
        """The person of each camera and frame, empty for cameras that have one alone; and notes."""
        several = {
            name: read_people(path, self.files.options_of(name))
            for name, path in self.files.places.items()
            if name in self.rig and path.suffix.lower() != ".npz"
        }
        most = max((len(people) for frames in several.values() for people in frames.values()), default=0)
        if most < 2:
            if self.subject not in (None, 1):
                raise InputError("--subject", expected="1: one person is in view", received=str(self.subject))
            return {}, ()
        return choose_subject(several, self.rig, self.distortions, subject=self.subject, mask=self.mask)


def choose_subject(
    people: Mapping[str, Mapping[int, Sequence[Person]]],
    cameras: Mapping[str, Camera],
    distortions: Mapping[str, Distortion],
    *,
    subject: int | None = None,
    mask: MaskReader | None = None,
) -> tuple[dict[str, dict[int, Person | None]], tuple[str, ...]]:
    """Choose one person over all cameras and frames.

    Args:
        people: by camera and frame, in pixels of the images on disk.
        cameras: full cameras of the undistorted images.
        distortions: of distorted images.
        subject: place in the order of preference, from 1; None: 1.
        mask: reads the masks of the person that is wanted.

    Returns:
        The person of each camera and frame, None where nobody is the subject; and sentences about who was taken.

    Raises:
        InputError: a `subject` that nobody is.
    """
    names = [name for name in cameras if name in people]
    frames = sorted({frame for name in names for frame in people[name]})
    views = _Views.of(people, {name: cameras[name] for name in names}, distortions, frames)
    found = {frame: people_in_space(views.sighted[frame]) for frame in frames}
    tracks = sorted(_scored(_followed(found), views, mask), key=lambda track: -track.score)
    if not tracks:
        # No two views agree on anybody: each view's surest person is all that is known.
        surest = {name: {f: chosen_person(own, None) for f, own in people[name].items()} for name in names}
        return surest, ("no two cameras agree on a person: the surest one of each view was taken",)
    place = 1 if subject is None else subject
    if not 1 <= place <= len(tracks):
        raise InputError("--subject", expected=f"1 to {len(tracks)}, the people in view", received=str(subject))
    chosen = _members(tracks[place - 1], tracks, views)
    out = {
        name: {frame: None if (k := chosen[name].get(frame)) is None else own[k] for frame, own in people[name].items()}
        for name in names
    }
    return out, _described(tracks, place)


@dataclass(frozen=True, eq=False)
class _Views:
    """People of all views as rays, and where they are in the files.

    Attributes:
        names: of the cameras.
        sighted: people of each frame.
        place: index of each of them in its list, by frame.
        height: of each in its image, a share of the image's height, by frame.
        focus: point that the cameras look at, metres.
        reach: median distance of the cameras from it.
        points: pixels of each, by frame, for masks.
    """

    names: tuple[str, ...]
    sighted: Mapping[int, Sighted]
    place: Mapping[int, list[int]]
    height: Mapping[int, list[float]]
    focus: Float64[np.ndarray, " 3"]
    reach: float
    points: Mapping[int, list[Float64[np.ndarray, "n 2"]]]

    @staticmethod
    def of(
        people: Mapping[str, Mapping[int, Sequence[Person]]],
        cameras: Mapping[str, Camera],
        distortions: Mapping[str, Distortion],
        frames: Sequence[int],
    ) -> _Views:
        """Turn the points of all people into rays of the world."""
        listed = [
            (c, frame, k, one)
            for c, name in enumerate(cameras)
            for frame, own in people[name].items()
            for k, one in enumerate(own)
        ]
        points = tuple(
            dict.fromkeys(
                n for *_, one in listed for n in one.points if any(p in n for p in _PARTS) and "face" not in n
            )
        )
        table = np.zeros((len(listed), len(points), 3))
        for row, (*_, one) in enumerate(listed):
            for column, name in enumerate(points):
                table[row, column] = one.points.get(name, 0.0)
        table[table[..., 2] < _LEAST_CONFIDENCE] = 0.0
        rays, origin = np.zeros((*table.shape[:2], 3)), np.zeros((len(listed), 3))
        camera_of = np.array([c for c, *_ in listed], dtype=np.int64)
        for c, (name, camera) in enumerate(cameras.items()):
            rows = np.flatnonzero(camera_of == c)
            there = table[rows, :, 2] > 0
            plane = (table[rows][there][:, :2] - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
            if name in distortions:
                plane = distortions[name].undistort(plane)
            lost = ~np.isfinite(plane).all(axis=1)
            own = np.concatenate([np.where(lost[:, None], 0.0, plane), np.ones((len(plane), 1))], axis=1)
            own = own @ camera.cam_from_world[:3, :3]
            full = np.zeros((len(rows), len(points), 3))
            full[there] = own / np.linalg.norm(own, axis=1, keepdims=True)
            rays[rows], origin[rows] = full, camera.position
            seen = table[rows, :, 2]
            seen[there] = np.where(lost, 0.0, seen[there])
            table[rows, :, 2] = seen
        by_frame = {frame: [row for row, item in enumerate(listed) if item[1] == frame] for frame in ()}
        for row, item in enumerate(listed):
            by_frame.setdefault(item[1], []).append(row)
        heights = [camera.height for camera in cameras.values()]
        sizes = [_height(one) / heights[c] for c, one in zip(camera_of.tolist(), table, strict=True)]
        centres = np.stack([camera.position for camera in cameras.values()])
        focus = focus_of(centres, np.stack([camera.cam_from_world[2, :3] for camera in cameras.values()]))
        rows_of = {frame: by_frame.get(frame, []) for frame in frames}
        return _Views(
            tuple(cameras),
            {f: Sighted(camera_of[r], origin[r], rays[r], table[r, :, 2]) for f, r in rows_of.items()},
            {f: [listed[row][2] for row in r] for f, r in rows_of.items()},
            {f: [sizes[row] for row in r] for f, r in rows_of.items()},
            focus,
            float(np.median(np.linalg.norm(centres - focus, axis=1))),
            {f: [table[row][table[row, :, 2] > 0, :2] for row in r] for f, r in rows_of.items()},
        )


def _height(points: Float64[np.ndarray, "K 3"]) -> float:
    """Return the height in pixels of the seen points; 0 for fewer than two."""
    seen = points[points[:, 2] > 0]
    return float(np.ptp(seen[:, 1])) if len(seen) > 1 else 0.0


def _followed(found: Mapping[int, Sequence[PersonInSpace]]) -> list[Track]:
    """Follow people from frame to frame, each to the nearest place."""
    places: list[dict[int, PersonInSpace]] = []
    last: list[tuple[int, np.ndarray]] = []
    for frame, people in found.items():
        if not people:
            continue
        centres = np.stack([one.centre for one in people])
        taken: set[int] = set()
        if places:
            away = np.linalg.norm(centres[None] - np.stack([where for _, where in last])[:, None], axis=2)
            # After a gap a person may be farther; the gap counts in frames of the keypoints.
            reach = np.array([min(_REACH, _STEP * max(1, frame - when) ** 0.5) for when, _ in last])
            allowed = away < reach[:, None]
            for row, column in zip(*linear_sum_assignment(np.where(allowed, away, 1e3)), strict=True):
                if allowed[row, column]:
                    places[row][frame], last[row] = people[column], (frame, centres[column])
                    taken.add(int(column))
        for column in set(range(len(people))) - taken:
            places.append({frame: people[column]})
            last.append((frame, centres[column]))
    return [Track(one) for one in places]


def _scored(tracks: Sequence[Track], views: _Views, mask: MaskReader | None) -> list[Track]:
    """Return the people with their scores."""
    total = max(1, (len(views.names) - 1) * len(views.sighted))
    out = []
    for track in tracks:
        # A person in two views of four has one agreement of three possible.
        agreed = sum(len(place.members) - 1 for place in track.places.values()) / total
        size = float(np.mean([views.height[f][row] for f, place in track.places.items() for row in place.members]))
        off = float(np.linalg.norm(track.centre() - views.focus)) / (0.5 * views.reach)
        score = agreed * (0.2 + size) / (1.0 + off**2)
        out.append(Track(track.places, score, agreed))
    if mask is None or len(out) < 2:
        return out
    return [Track(t.places, t.score * (0.05 + _inside(t, views, mask)), t.views) for t in out]


def _inside(track: Track, views: _Views, mask: MaskReader) -> float:
    """Return the share of a person's points inside the masks of a few frames; 0.5 without any mask."""
    inside, count = 0, 0
    for frame in list(track.places)[:: max(1, len(track.places) // _MASKED_FRAMES)][:_MASKED_FRAMES]:
        for row in track.places[frame].members:
            shown = mask(views.names[int(views.sighted[frame].camera[row])], frame)
            if shown is None:
                continue
            column, line = np.floor(views.points[frame][row]).astype(int).T
            there = (column >= 0) & (line >= 0) & (column < shown.shape[1]) & (line < shown.shape[0])
            inside += int((shown[line[there], column[there]] > 127).sum())
            count += len(column)
    return inside / count if count else 0.5


def _members(track: Track, tracks: Sequence[Track], views: _Views) -> dict[str, dict[int, int]]:
    """Return the place in its list of the subject of each camera and frame, also where two views alone do not tell."""
    agreeing = np.zeros(len(views.names))
    for frame, place in track.places.items():
        agreeing[views.sighted[frame].camera[list(place.members)]] += 1
    misplaced: Bool[np.ndarray, " C"] = agreeing < _DISAGREES * len(track.places)
    out: dict[str, dict[int, int]] = {name: {} for name in views.names}
    for frame, seen in views.sighted.items():
        own = track.places[frame].members if frame in track.places else ()
        others = {row for t in tracks if t is not track and frame in t.places for row in t.places[frame].members}
        points = _points_at(track, frame)
        for c, name in enumerate(views.names):
            rows = [row for row in np.flatnonzero(seen.camera == c).tolist() if row not in others]
            mine = next((row for row in rows if row in own), None)
            if mine is None and rows and points is not None:
                costs = [typical_distance(seen, row, points) for row in rows]
                best = int(np.argmin(costs))
                # A camera that agrees in no frame may be misplaced, which triangulation then names.
                if costs[best] < (np.inf if misplaced[c] else _JOINS):
                    mine = rows[best]
            if mine is not None:
                out[name][frame] = views.place[frame][mine]
    return out


def _points_at(track: Track, frame: int) -> Float64[np.ndarray, "K 3"] | None:
    """Return the person's points in a frame, interpolated between the frames around it; those of the nearest at the ends."""
    if frame in track.places:
        return track.places[frame].points
    known = np.array(sorted(track.places))
    after = int(np.searchsorted(known, frame))
    if after in (0, len(known)):
        nearest = int(known[0 if after == 0 else -1])
        return track.places[nearest].points if abs(nearest - frame) <= 15 else None
    first, second = int(known[after - 1]), int(known[after])
    share = (frame - first) / (second - first)
    return (1 - share) * track.places[first].points + share * track.places[second].points


def _described(tracks: Sequence[Track], place: int) -> tuple[str, ...]:
    """Return a sentence about the people in view, if there are several."""
    worth = [k for k, track in enumerate(tracks) if k == place - 1 or track.views > 0.02][:_NAMED]
    if len(worth) < 2:
        return ()

    def words(k: int) -> str:
        x, _, z = tracks[k].centre()
        return f"{k + 1} at x {x:.1f}, z {z:.1f} m in {len(tracks[k].places)} frames"

    named = "; ".join(words(k) for k in worth)
    return (f"several people in view ({named}): number {place} was taken (--subject N takes another)",)
