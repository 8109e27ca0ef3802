"""What can be told without opening an image: missing files, and splits that name what is not there."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from smplxpp.capture import Capture, Problem, find_problems
from smplxpp.capture.check.findings import Finding

# What `find_problems` says without decoding -> kind; the first that matches.
_KINDS = (
    (r"^calibration \S+ \(\w+\): |^no (keypoints|images) of the cameras ", "rig-guessed"),
    (r"videos, which `smplxpp capture convert` decodes", "rig-videos"),
    (r"not calibrated$", "camera-uncalibrated"),
    (r"calibrated, but without any image$", "camera-without-images"),
    (r"an image in camera .* alone$", "frame-alone"),
    (r"no image of frame \d+$|: named in .*, but missing$", "image-missing"),
    (r"is outside of the undistorted one$", "lens-loss"),
    (r": left aside$", "left-aside"),
    (r"where \+y is expected", "world-up"),
    (r"name the model that they were fitted with", "params-body"),
    (r"^no masks: ", "masks-none"),
    (r"no mask( of frame \d+)?$", "mask-missing"),
    (r"no (label|normal) of frame \d+$", "map-missing"),
    (r"no body parameters$", "params-missing"),
    (r"NaN or infinity|\bparam|smpl", "params-broken"),
)


def missing_findings(capture: Capture) -> list[Finding]:
    """Find cameras without images, gaps, images without masks, frames without parameters or with broken ones."""
    found = [_classified(problem) for problem in find_problems(capture, decode=False)]
    if capture.recording.params is None:
        found.append(Finding("params-none", "no body parameters: calibration and masks cannot be held against a body"))
    return found


def _classified(problem: Problem) -> Finding:
    kind = next((kind for pattern, kind in _KINDS if re.search(pattern, problem.message)), "file-other")
    if kind == "file-other" and problem.camera is None and problem.frame is not None:
        kind = "params-broken"
    return Finding(kind, problem.message, problem.camera, problem.frame)


def split_findings(capture: Capture) -> Iterator[Finding]:
    """Find splits that hold nothing to train or to test on, and what no split holds."""
    splits, images = capture.splits, capture.presence()
    # (C, F): a camera or a frame is seen if any image of it exists.
    seen_cameras = {name for name, has in zip(capture.cameras, images, strict=True) if has.any()}
    seen_frames = {frame for frame, has in zip(capture.frames, images.T, strict=True) if has.any()}
    # Empty training sets stop a training; empty test sets make its evaluation meaningless.
    if not seen_cameras.intersection(splits.train_cameras):
        yield Finding("split-empty", "no camera with images is trained on")
    if not seen_frames.intersection(splits.train_frames):
        yield Finding("split-empty", "no frame with images is trained on")
    for name in splits.novel_view_cameras:
        if name not in seen_cameras:
            yield Finding("split-empty", f"camera {name} is held out as a novel view, but has no image", name)
    for frame in splits.novel_pose_frames:
        if frame not in seen_frames:
            yield Finding("split-empty", f"frame {frame} is held out as a novel pose, but has no image", None, frame)
    # Data that no split holds is silently unused, which is rarely intended.
    unused = sorted(seen_cameras - set(splits.train_cameras) - set(splits.novel_view_cameras))
    if unused:
        yield Finding("split-leftover", f"cameras that no split holds: {', '.join(unused)}")
    left = np.array(sorted(seen_frames - set(splits.train_frames) - set(splits.novel_pose_frames)), dtype=np.int64)
    if len(left):
        yield Finding("split-leftover", f"frames that no split holds: {in_ranges(left)}")


def in_ranges(numbers: Int[np.ndarray, " N"]) -> str:
    """Write ascending numbers in words: `0-3, 7, 9-10`; "" for none."""
    if not len(numbers):
        return ""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)
