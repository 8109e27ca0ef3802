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

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.keypoint_files import joined, read_people
from smplxpp.capture.keypoint_people import Person, chosen_person
from smplxpp.capture.keypoints import KeypointFiles
from smplxpp.capture.subject_geometry import PersonInSpace, Views, people_in_space, typical_distance
from smplxpp.core import Camera, InputError, Keypoints2D

MaskReader = Callable[[str, int], "np.ndarray | None"]
"""Reads the mask of a camera and a frame as (H, W) opacity of the image on disk; None without one."""

# A person moves at most so far between two frames, metres, and is taken up again within the larger one after a gap.
_STEP, _REACH = 0.6, 2.0
# Distance of rays, metres, up to which a view joins a person known from the other views or frames.
_JOINS = 0.35
# Share of a person's frames below which a camera that never agrees counts as misplaced: its nearest person is kept.
_DISAGREES = 0.1
_MASKED_FRAMES = 5  # frames whose masks are read
_MOST_FRAMES = 300  # frames in which people of all views are compared, 25 ms each with four cameras
_NAMED = 4  # people that a note describes


@dataclass(frozen=True, eq=False)
class Track:
    """A person followed through the frames.

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
        """Return the numbers of the frames with keypoints."""
        return self.files.frames()

    def read(self, camera: str) -> Keypoints2D | None:
        """Read the subject's keypoints of a camera, None without any.

        Raises:
            InputError: a damaged file, or a `subject` that is no person found.
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
        The person of each camera and frame, None where the subject is not seen; and sentences about who was taken.

    Raises:
        InputError: a `subject` that is no person found.
    """
    names = [name for name in cameras if name in people]
    frames = sorted({frame for name in names for frame in people[name]})
    views = Views.of(people, {name: cameras[name] for name in names}, distortions, frames)
    # A long take is compared at evenly spread frames; between these, positions are interpolated.
    compared = frames[:: max(1, len(frames) // _MOST_FRAMES)]
    found = {frame: people_in_space(views.sighted[frame]) for frame in compared}
    tracks = sorted(_scored(_followed(found), views, mask, len(found)), key=lambda track: -track.score)
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


def _scored(tracks: Sequence[Track], views: Views, mask: MaskReader | None, compared: int) -> list[Track]:
    """Score the people; `compared` is the number of frames in which views were compared."""
    total = max(1, (len(views.names) - 1) * compared)
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


def _inside(track: Track, views: Views, mask: MaskReader) -> float:
    """Return the share of a person's points inside the masks of a few frames; 0.5 without any mask."""
    inside, count = 0, 0
    for frame in list(track.places)[:: max(1, len(track.places) // _MASKED_FRAMES)][:_MASKED_FRAMES]:
        for row in track.places[frame].members:
            shown = mask(views.names[int(views.sighted[frame].camera[row])], frame)
            if shown is None:
                continue
            column, line = np.floor(views.points[frame][row]).astype(int).T
            in_image = (column >= 0) & (line >= 0) & (column < shown.shape[1]) & (line < shown.shape[0])
            inside += int((shown[line[in_image], column[in_image]] > 127).sum())
            count += len(column)
    return inside / count if count else 0.5


def _members(track: Track, tracks: Sequence[Track], views: Views) -> dict[str, dict[int, int]]:
    """Return the subject's index among the people of each camera and frame, also where fewer than two views agree."""
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
    """Return the person's points in a frame, interpolated between those around it, at the ends those of the nearest."""
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
