"""The calibration against the silhouettes: which cameras and frames do not fit, and why."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from smplxpp.capture.check.findings import Finding
from smplxpp.capture.check.mistakes import COMBINED, SINGLE, Mistake, Sample, shifts
from smplxpp.capture.check.views import (
    IOU_BAD,
    MIN_SHARE,
    OUTSIDE_BAD,
    OUTSIDE_DOUBTFUL,
    FitSummary,
    SilhouetteFit,
    ViewCheck,
    body_silhouette,
    compare_silhouettes,
    summary,
)
from smplxpp.core import Camera, spread

# A correction explains the misfit if the body is then this far inside the masks, and the overlap this much larger.
_FITS_OUTSIDE, _GAIN = 2 * OUTSIDE_DOUBTFUL, 0.05
_FEW, _HOPELESS = 4, 6 * OUTSIDE_DOUBTFUL


@dataclass(frozen=True)
class Diagnosis:
    """The simplest correction that fits, and how well."""

    mistake: Mistake
    before: SilhouetteFit
    after: SilhouetteFit


def diagnose(samples: Sequence[Sample], extra: Sequence[Mistake] = ()) -> Diagnosis | None:
    """Find the correction that brings the body into the masks; None where none does.

    Args:
        samples: views that do not fit.
        extra: corrections to try besides the usual ones (another camera's calibration, say).
    """
    before = _score(samples, Mistake("", ""))
    # Single mistakes before combined ones: the simplest explanation wins.
    for level in ((*SINGLE, *extra, *shifts(samples)), COMBINED):
        # Most corrections are hopeless, which a few views show.
        likely = [mistake for mistake in level if _score(samples[::_FEW], mistake).outside < _HOPELESS]
        scored = [(_score(samples, mistake), mistake) for mistake in likely]
        fitting = [item for item in scored if _explains(before, item[0])]
        if fitting:
            # Overlap alone would prefer a large body; the share outside the mask tells whether it fits inside.
            after, mistake = max(fitting, key=lambda item: item[0].iou - item[0].outside)
            return Diagnosis(mistake, before, after)
    return None


def _explains(before: SilhouetteFit, after: SilhouetteFit) -> bool:
    inside = after.outside < min(_FITS_OUTSIDE, 0.5 * before.outside)
    return inside and after.iou > max(IOU_BAD, before.iou + _GAIN)


def _score(samples: Sequence[Sample], mistake: Mistake) -> SilhouetteFit:
    """Return mean figures over the samples that the correction applies to, which have to be half of them."""
    fits = []
    for sample in samples:
        vertices = mistake.body(sample)
        if vertices is not None:
            # A mistake corrects the camera, the body, or both; a body that is not seen counts as all outside.
            silhouette = body_silhouette(vertices, sample.faces, mistake.camera(sample.camera))
            fits.append(compare_silhouettes(silhouette, sample.mask) or SilhouetteFit(1.0, 0.0))
    # A correction that applies to fewer than half of the samples (a shift in time at the ends) proves nothing.
    if 2 * len(fits) < max(1, len(samples)):
        return SilhouetteFit(1.0, 0.0)
    return SilhouetteFit(float(np.mean([f.outside for f in fits])), float(np.mean([f.iou for f in fits])))


# A frame does not fit by itself if it is bad in this share of its cameras. Single frames and cameras are to blame if
# they are this much worse than the median.
_MOST, _WORSE = 0.6, 2.5
_SAMPLE_CAMERAS, _SAMPLE_FRAMES = 4, 3

Key = TypeVar("Key", bound=Hashable)
Sampler = Callable[[str, int], Sample | None]


def by_camera(views: Iterable[ViewCheck]) -> dict[str, FitSummary]:
    """Return the figures of each camera that sees the body."""
    return _summaries(views, lambda view: view.camera)


def by_frame(views: Iterable[ViewCheck]) -> dict[int, FitSummary]:
    """Return the figures of each frame in which the body is seen."""
    return _summaries(views, lambda view: view.frame)


def calibration_findings(views: Sequence[ViewCheck], rig: Mapping[str, Camera], sampler: Sampler) -> Iterator[Finding]:
    """Find single frames that do not fit, single cameras that do not, or all: with the mistake that explains it.

    Args:
        views: all that were looked at.
        rig: cameras by name, of the masks' sizes.
        sampler: gives the view of a camera and a frame to try corrections on.
    """
    frames = by_frame(views)
    # Frames first: one frame with wrong parameters would otherwise count against every camera.
    lost = {frame for frame in _outliers(frames) if frames[frame].views > 1}
    lost = {frame for frame in lost if frames[frame].bad >= _MOST * frames[frame].views}
    # Cameras are judged by the frames that do fit.
    rest = [view for view in views if view.frame not in lost]
    cameras = by_camera(rest)
    for frame in sorted(lost):
        s = frames[frame]
        words = f"frame {frame}: the body does not fit the masks in {s.bad} of {s.views} cameras ({_figures(s)})"
        yield Finding("calibration-frame", words, None, frame)
    bad = [name for name, s in cameras.items() if s.verdict == "bad"]
    # If half of the cameras are bad, the convention of the whole calibration is wrong rather than single cameras.
    if bad and 2 * len(bad) >= len(cameras):
        yield _everywhere(rest, bad, cameras, sampler)
        return
    # Single bad cameras: their images may be exchanged with those of another camera.
    to_blame = _outliers(cameras)
    for name in to_blame:
        yield _one_camera(name, rest, cameras[name], sampler, rig)
    # What remains fits roughly: a noisy tracker, or loose calibration.
    doubtful = [name for name, s in cameras.items() if s.verdict != "good" and name not in to_blame]
    if doubtful:
        yield _loose(doubtful, rest, cameras, sampler)


def _outliers(fits: Mapping[Key, FitSummary]) -> list[Key]:
    """Return the bad ones that are much worse than most: with rough parameters all are, and none is to blame."""
    if not fits:
        return []
    # An outlier is judged against the median, which single bad keys do not move.
    usual = float(np.median([fit.outside for fit in fits.values()]))
    return [
        key
        for key, fit in fits.items()
        if fit.verdict == "bad" and usual < OUTSIDE_BAD and (fit.outside > _WORSE * usual or fit.iou < IOU_BAD)
    ]


def blind_cameras(views: Iterable[ViewCheck]) -> Iterator[Finding]:
    """Find cameras whose every mask is empty, and into which the body does not project either."""
    blind: dict[str, bool] = {}
    for view in views:
        empty = view.mask_share is not None and view.mask_share < MIN_SHARE and not view.fit and not view.findings
        blind[view.camera] = blind.get(view.camera, True) and empty
    for name in (name for name, empty in blind.items() if empty):
        yield Finding("camera-sees-nobody", f"camera {name}: its masks are empty, it never sees the person", name)


def _everywhere(
    views: Sequence[ViewCheck], bad: Sequence[str], cameras: Mapping[str, FitSummary], sampler: Sampler
) -> Finding:
    # A few cameras show a wrong convention as well as all do, and each correction is rendered for each of them.
    chosen = spread(bad, _SAMPLE_CAMERAS)
    result = diagnose(_samples(views, chosen, sampler))
    fit = summary(view.fit for view in views if view.fit)
    assert fit is not None  # bad cameras have views with figures
    which = "any camera" if len(bad) == len(cameras) else f"{len(bad)} of {len(cameras)} cameras"
    words = f"the body does not fit the masks of {which} ({_figures(fit)})"
    words, advice = _explained(words, result)
    return Finding("calibration", words, advice=advice)


def _one_camera(
    name: str,
    views: Sequence[ViewCheck],
    fit: FitSummary,
    sampler: Sampler,
    rig: Mapping[str, Camera],
) -> Finding:
    # A folder under the wrong name is the usual mistake with a single camera; only cameras of the same size can be
    # exchanged.
    swaps = [
        Mistake(
            f"its images are those of camera {other.name}",
            f"exchange the folders, or the calibrations, of {name} and {other.name}",
            camera=_replaced_by(other),
        )
        for other in rig.values()
        if other.name != name and (other.width, other.height) == (rig[name].width, rig[name].height)
    ]
    words = f"camera {name}: the body does not fit its masks ({_figures(fit)})"
    words, advice = _explained(words, diagnose(_samples(views, [name], sampler), swaps))
    return Finding("calibration-camera", words, name, advice=advice)


def _replaced_by(other: Camera) -> Callable[[Camera], Camera]:
    """Make the correction that takes another camera's calibration."""
    return lambda _: other


def _loose(
    doubtful: Sequence[str], views: Sequence[ViewCheck], cameras: Mapping[str, FitSummary], sampler: Sampler
) -> Finding:
    median = float(np.median([cameras[name].outside for name in doubtful]))
    which = "every camera" if len(doubtful) == len(cameras) else ", ".join(doubtful)
    words = f"the body sticks out of the masks of {which}, by {median:.1%} of its area at the median"
    words, advice = _explained(words, diagnose(_samples(views, spread(doubtful, _SAMPLE_CAMERAS), sampler)))
    return Finding("calibration-loose", words, advice=advice)


def _explained(words: str, result: Diagnosis | None) -> tuple[str, str]:
    """Return words and advice; the diagnosis goes first where there is one."""
    if result is None:
        return words, ""
    after = f"{result.after.outside:.0%} outside, overlap {result.after.iou:.2f}"
    return f"{words}. It would fit if {result.mistake.words} ({after})", result.mistake.advice


def _samples(views: Sequence[ViewCheck], cameras: Sequence[str], sampler: Sampler) -> list[Sample]:
    """Pick a few views of each camera to try corrections on."""
    found = []
    for name in cameras:
        frames = [view.frame for view in views if view.camera == name and view.fit is not None]
        found += [sampler(name, frame) for frame in spread(frames, _SAMPLE_FRAMES)]
    return [sample for sample in found if sample is not None]


def _figures(s: FitSummary) -> str:
    return f"{s.outside:.0%} of it outside of them, overlap {s.iou:.2f}"


def _summaries(views: Iterable[ViewCheck], key: Callable[[ViewCheck], Key]) -> dict[Key, FitSummary]:
    groups: dict[Key, list[SilhouetteFit]] = {}
    for view in views:
        if view.fit is not None:
            groups.setdefault(key(view), []).append(view.fit)
    summaries = {name: summary(fits) for name, fits in groups.items()}
    return {name: fit for name, fit in summaries.items() if fit is not None}
