"""Find what can be told without opening an image: missing files, splits, and body parameters in the wrong units."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from smplxpp.body import BodyModel
from smplxpp.capture import Capture, Problem, find_problems
from smplxpp.capture.check.findings import Finding
from smplxpp.core import POSE_BLOCKS, BodyParams, InputError

# What `find_problems` says without decoding -> kind; the first that matches.
_KINDS = (
    (r"^calibration \S+ \(\w+\): |^no (keypoints|images) of the cameras ", "rig-guessed"),
    (r"videos, which `smplxpp capture convert` decodes", "rig-videos"),
    (r"not calibrated$", "camera-uncalibrated"),
    (r"calibrated, but without any image$", "camera-without-images"),
    (r"an image in camera .* alone$", "frame-alone"),
    (r"no image of frame \d+$|: named in .*, but missing$", "image-missing"),
    (r"is outside of the undistorted one$|of the undistorted one stay black$", "lens-loss"),
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


BETA_LIMIT = 5.0
_BETAS_VARY = 0.01
# Coefficients of learned expressions, and weights of named blend shapes, whose own range is 0 to 1.
_EXPRESSION_LIMITS = (-8.0, 8.0)
_BLEND_SHAPE_LIMITS = (-1.0, 2.0)
# Radians. A longer rotation vector is more than a full turn; in degrees 7 would be common.
_ANGLE_LIMIT = 7.0
_SPEED_LIMIT = 12.0
_STEP_LIMIT = 0.5
# A person farther from the rig than 4 times its radius plus 10 m is outside of any room.
_FAR, _FAR_METRES = 4.0, 10.0
_UNITS = ((0.01, "centimetres"), (0.001, "millimetres"), (100.0, "hectometres"))


def read_parameters(capture: Capture) -> dict[int, BodyParams]:
    """Read the parameters of every frame whose parameters can be read."""
    found = {}
    for frame in capture.frames:
        try:
            params = capture.params(frame)
        except InputError:  # already among the missing ones
            continue
        if params is not None:
            found[frame] = params
    return found


def parameter_findings(capture: Capture, params: dict[int, BodyParams], body: BodyModel) -> list[Finding]:
    """Find shapes, expressions and angles out of range, other units, jumps."""
    found: list[Finding] = []
    for frame, p in params.items():
        found += _out_of_range(frame, p, body)
    found += [*_large_betas(params), *_varying_betas(params)]
    if params:
        # Units come before jumps: in millimetres every step is a jump.
        units = list(_wrong_units(capture, params))
        found += units or _jumps(capture, params)
    return found


def _out_of_range(frame: int, p: BodyParams, body: BodyModel) -> Iterator[Finding]:
    # Learned expressions are unbounded principal components, named blend shapes are weights.
    named = not body.expression_names[:1] == ("expression_00",)
    low, high = _BLEND_SHAPE_LIMITS if named else _EXPRESSION_LIMITS
    least, most = float(p.expression.min(initial=0.0)), float(p.expression.max(initial=0.0))
    if least < low or most > high:
        message = f"frame {frame}: expression from {least:.3g} to {most:.3g}, within {low:g} to {high:g} is possible"
        yield Finding("params-expression", message, None, frame)
    # Hands of fewer than 45 numbers are coefficients, no angles.
    blocks = {name: getattr(p, name) for name, joints in POSE_BLOCKS if getattr(p, name).shape[1] == 3 * joints}
    # A rotation vector of more than 2 pi is legal but never written by a fit; degrees exceed it at once.
    name, angle = max(((n, float(np.abs(v).max(initial=0.0))) for n, v in blocks.items()), key=lambda item: item[1])
    if angle > _ANGLE_LIMIT:
        unit = ", as degrees would" if angle > 30 else ""
        yield Finding("params-angles", f"frame {frame}: {name} reaches {angle:.3g} radians{unit}", None, frame)


def _large_betas(params: dict[int, BodyParams]) -> Iterator[Finding]:
    """Find shapes outside of `BETA_LIMIT`, once for all frames that share one."""
    # Betas are in standard deviations of the shapes that the model was learned from.
    alike: dict[float, list[int]] = {}
    for frame, p in params.items():
        largest = float(np.abs(p.betas).max(initial=0.0))
        if largest > BETA_LIMIT:
            alike.setdefault(largest, []).append(frame)
    for largest, frames in alike.items():
        where = f"frame {frames[0]}" if len(frames) == 1 else f"frames {in_ranges(np.array(frames))}"
        yield Finding("params-betas", f"{where}: betas reach {largest:.3g}", None, frames[0])


def _varying_betas(params: dict[int, BodyParams]) -> Iterator[Finding]:
    if len({p.betas.shape for p in params.values()}) == 1 and len(params) > 1:
        betas = np.concatenate([p.betas for p in params.values()])
        spread = float(np.ptp(betas, axis=0).max(initial=0.0))
        if spread > _BETAS_VARY:
            yield Finding("params-betas-vary", f"betas differ by up to {spread:.3g} between frames")


def _wrong_units(capture: Capture, params: dict[int, BodyParams]) -> Iterator[Finding]:
    # The median of the cameras' positions is the middle of the rig even if one camera is far off.
    positions = np.array([camera.position for camera in capture.cameras.values()])
    if not len(positions):
        return
    center = np.median(positions, axis=0)
    radius = float(np.median(np.linalg.norm(positions - center, axis=1)))
    transl = np.concatenate([p.transl for p in params.values()])
    limit = _FAR * radius + _FAR_METRES

    def distance(scale: float) -> float:
        return float(np.median(np.linalg.norm(transl * scale - center, axis=1)))

    # Try other units: the right one puts the person among the cameras.
    if distance(1.0) > limit:
        fitting = next((name for scale, name in _UNITS if distance(scale) < 2 * radius + 1.0), None)
        hint = f"; in {fitting} it would be among the cameras" if fitting else ""
        yield Finding(
            "params-units",
            f"transl puts the person {distance(1.0):.4g} m from the cameras' middle, {radius:.3g} m around which they "
            f"stand{hint}",
        )
    # Person and cameras agree, but both are huge: both are in another unit.
    elif radius > 100.0:
        yield Finding("params-units", f"the cameras stand {radius:.4g} m around their middle: are they in millimetres?")


def _jumps(capture: Capture, params: dict[int, BodyParams]) -> Iterator[Finding]:
    frames = np.array(sorted(params))
    transl = np.concatenate([params[int(frame)].transl for frame in frames])
    steps = np.linalg.norm(np.diff(transl, axis=0), axis=1)
    limit = _SPEED_LIMIT / capture.fps if capture.fps else _STEP_LIMIT
    for k in np.flatnonzero((np.diff(frames) == 1) & (steps > limit)):
        message = f"frame {frames[k + 1]}: transl jumps by {steps[k]:.3g} m from frame {frames[k]}"
        speed = f", {steps[k] * capture.fps:.3g} m/s" if capture.fps else ""
        yield Finding("params-jump", message + speed, None, int(frames[k + 1]))
