"""Say what a file of motion holds before it is used: skeleton, frames, rate, unit, axes, ranges, likely mistakes."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from smplxpp.body.importers import detect_layout, family_of_params, is_skeleton, load_params, up_of_params
from smplxpp.body.loader import load_body
from smplxpp.body.model import BodyModel
from smplxpp.body.retarget import FEET, Skeleton
from smplxpp.body.skeleton_params import (
    MatchedSkeleton,
    matched_skeleton,
    named_joints,
    read_skeleton,
    skeleton_params,
    warn_of_stretching,
)
from smplxpp.core import DEFAULT_FPS, BodyParams, GeometryWarning, InputError, matrix_from_rotvec

# Metres of the units that files are written in; CMU's library counts in 0.45 of an inch, by 25.4 mm / 0.45.
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "CMU's unit (56.4 mm)": 0.0254 / 0.45}
_LEG = (0.55, 1.1)  # metres from hip to ankle of people from a child of ten years on
# Bounds of what people and their recordings do; farther means a wrong unit or rate.
_RATES = (5.0, 300.0)  # frames a second
_SPAN, _FASTEST = 100.0, 20.0  # metres that a take spans, metres a second of a joint
_WHOLE_TURN = 2.0 * np.pi + 0.1  # radians of a joint's rotation, and rounding
_TIMES = 20.0


@dataclass(frozen=True)
class MotionFacts:
    """What a file of motion holds.

    Attributes:
        kind: ending of a skeleton's file, as "bvh", or the layout of the parameters.
        family: of the body that the parameters are of; None: the open body's, or not told.
        frames: number of frames.
        fps: frames a second that the file states; None: none.
        unit: of places, with the length of a leg of a skeleton.
        up: axis that points up in the file, as "y".
        skeleton: for a skeleton's motion, the file's joints for each of ours, and what is missing; else empty.
        left_out: what the file has and is not read.
        ranges: extents of the travel and heights in metres, speeds in metres a second, turns in degrees.
        mistakes: sentences on what is likely wrong, with remedies.
    """

    kind: str
    family: str | None
    frames: int
    fps: float | None
    unit: str
    up: str
    skeleton: dict[str, Any] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    ranges: dict[str, Any] = field(default_factory=dict)
    mistakes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the facts as JSON values."""
        rate = self.fps or DEFAULT_FPS
        return asdict(self) | {
            "seconds": self.frames / rate,
            "left_out": [*self.left_out],
            "mistakes": [*self.mistakes],
        }


def inspect_motion(
    path: str | Path,
    *,
    body: BodyModel | None = None,
    joint_map: Mapping[str, str] | None = None,
    person: int | None = None,
    up: Any = None,
    clip: str | None = None,
) -> MotionFacts:
    """Read a motion and say what was understood of it, what is left out, and what looks wrong.

    Args:
        path: body parameters in any layout, or the motion of a skeleton.
        body: that shall move; None: the open body.
        joint_map: our name for each of the names of a skeleton.
        person: id of the person, for files with several.
        up: axis that points up, where the file is wrong.
        clip: name of the motion, in a skeleton's file with several.

    Raises:
        InputError: a file that cannot be read.

    Example:
        >>> facts = inspect_motion("data/fixtures/person/params/params.npz")
        >>> facts.kind, facts.frames, facts.fps, facts.mistakes
        ('smplx', 16, 10.0, ())
    """
    path, body = Path(path), load_body() if body is None else body
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GeometryWarning)
        if is_skeleton(path):
            facts, params = _of_skeleton(path, Skeleton.of(body), joint_map, up, clip)
        else:
            family = family_of_params(path)
            params = load_params(path, body=body, person=person, up=up)
            facts = MotionFacts(detect_layout(path), family, len(params), params.fps, "m", up or up_of_params(path))
    notes = list(dict.fromkeys(str(one.message) for one in caught if issubclass(one.category, GeometryWarning)))
    if params is None:
        return facts
    ranges, mistakes = _looked_at(params, Skeleton.of(body))
    return replace(
        facts,
        ranges=ranges,
        left_out=(*facts.left_out, *(note for note in notes if note not in facts.mistakes)),
        mistakes=(*facts.mistakes, *mistakes),
    )


def skeleton_of_file(
    path: str | Path, *, joint_map: Mapping[str, str] | None = None, up: str | None = None, clip: str | None = None
) -> MatchedSkeleton:
    """Return which joints of a skeleton's file stand for the body's; arguments and errors are those of `load_skeleton`.

    Its warnings are given when the file is read for use.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        motion = read_skeleton(path, clip=clip)
        return matched_skeleton(motion, named_joints(motion, joint_map, subject=f"motion {path}"), up=up)


def _of_skeleton(
    path: Path, body: Skeleton, joint_map: Mapping[str, str] | None, up: str | None, clip: str | None
) -> tuple[MotionFacts, BodyParams | None]:
    """Return the facts of a skeleton and its motion for the body; None for a skeleton in which no person is found."""
    motion, kind = read_skeleton(path, clip=clip), path.suffix.lower()[1:]
    try:
        joints = named_joints(motion, joint_map, subject=f"motion {path}")
    except InputError as error:
        skeleton = {"names": list(motion.names)}
        facts = MotionFacts(kind, None, len(motion.root), motion.fps, "unknown", "unknown", skeleton)
        return replace(facts, mistakes=(str(error),)), None
    found = matched_skeleton(motion, joints, up=up)
    left_out = tuple(f"joint {name}, which turns" for name in found.left_out)
    warn_of_stretching(motion, joints, str(path))
    facts = MotionFacts(kind, None, len(motion.root), motion.fps, _unit(found.leg), found.up, found.as_dict(), left_out)
    return facts, skeleton_params(motion, joints, body, up=up)


def _unit(leg: float) -> str:
    """Return the unit in which a leg has the length of a person's."""
    fitting = [name for name, metres in _UNITS.items() if _LEG[0] <= leg * metres <= _LEG[1]]
    named = " or ".join(fitting) or "unknown"
    return f"{named}: a leg measures {leg:.4g}; steps are scaled by the legs"


def _looked_at(params: BodyParams, body: Skeleton) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the ranges of a motion for a body, and what looks wrong in them."""
    rate = params.fps or DEFAULT_FPS
    blocks = {name: getattr(params, name) for name in ("global_orient", "body_pose", "jaw_pose")}
    turns = np.linalg.norm(np.concatenate([*blocks.values()], axis=1).reshape(len(params), -1, 3), axis=2)
    names = [*body.names[:22], "jaw"]
    most = turns.max(axis=0)
    # Frames, spread over the motion, that ranges are taken from.
    looked_at = 3000
    # Steps are taken between neighbours; only the frames looked at are posed, in runs of two.
    first = np.unique(np.linspace(0, max(len(params) - 2, 0), min(len(params), looked_at)).astype(int))
    second = np.minimum(first + 1, len(params) - 1)
    here, there = (body.pose(params.select(rows)) for rows in (first, second))
    speed = np.linalg.norm(there - here, axis=2) * rate
    feet = here[:, body.at(*FEET), 1].min(axis=1)
    step = np.linalg.norm(np.diff(params.transl, axis=0), axis=1)
    repeated = _repeated(params)
    order = np.argsort(-most)[:3]
    ranges = {
        "way": [round(float(value), 3) for value in np.ptp(params.transl, axis=0)],
        "lowest_foot": [round(float(value), 3) for value in (feet.min(), feet.max())],
        "fastest_joint": [body.names[int(speed.max(axis=0).argmax())], round(float(speed.max()), 2)],
        "most_turned": {names[k]: round(float(np.degrees(most[k])), 1) for k in order},
        "repeated_frames": round(float(repeated), 3),
    }
    # What no person does, and what it comes from.
    mistakes = []
    if params.fps is None and len(params) > 1:
        mistakes.append(f"no frame rate is stated: {DEFAULT_FPS:g} a second are taken; --fps states another")
    elif not _RATES[0] <= rate <= _RATES[1] and len(params) > 1:
        mistakes.append(f"a rate of {rate:g} frames a second: --fps states another")
    if most.max() > _WHOLE_TURN:
        mistakes.append(
            f"rotations of up to {most.max():.0f} radians ({names[int(most.argmax())]}): degrees, to be converted"
        )
    span = float(np.ptp(params.transl, axis=0).max())
    if span > _SPAN:
        unit = "millimetres" if span > 1000.0 * _LEG[0] else "centimetres"
        mistakes.append(f"a way of {span:.0f} m: {unit}, to be converted to metres")
    elif speed.max() > _FASTEST and most.max() <= _WHOLE_TURN:
        mistakes.append(f"a joint at {speed.max():.0f} m a second: the rate is too high, or frames are missing")
    # Metres of the pelvis in one frame, at more than _TIMES its usual step.
    jump = 0.5
    jumps = np.flatnonzero((step > jump) & (step > _TIMES * np.median(step))) if len(step) else np.zeros(0, int)
    if len(jumps) and span <= _SPAN:
        mistakes.append(f"the person jumps {step[jumps].max():.1f} m from frame {jumps[0]} to the next")
    if (other := _lies(params)) is not None:
        mistakes.append(f"the person lies along {other} in most frames: --up {other}, if she should stand")
    if len(params) > 1 and repeated == 1.0:
        mistakes.append("all frames are the same: nothing moves")
    elif repeated > 0.2:
        mistakes.append(f"{100 * repeated:.0f} % of the frames repeat the one before: its rate was lower once")
    return ranges, tuple(mistakes)


def _repeated(params: BodyParams) -> float:
    """Return the share of frames that equal the one before in all joints and in place."""
    if len(params) < 2:
        return 0.0
    rows = np.concatenate([params.global_orient, params.body_pose, params.transl], axis=1)
    return float((np.abs(np.diff(rows, axis=0)).max(axis=1) < 1e-9).mean())


def _lies(params: BodyParams) -> str | None:
    """Return the axis that the pelvis' upward axis lies along in most frames, if that is not +y."""
    up: Float64[np.ndarray, "T 3"] = matrix_from_rotvec(params.global_orient)[:, :, 1]
    axis = np.argmax(np.abs(up), axis=1)
    sign = np.take_along_axis(up, axis[:, None], axis=1)[:, 0] < 0.0
    names = np.array([f"{'-' if below else ''}{'xyz'[k]}" for k, below in zip(axis, sign, strict=True)])
    found, count = np.unique(names, return_counts=True)
    common = str(found[count.argmax()])
    # Share of frames in which the trunk lies nearer to another axis than to the vertical.
    lies = 0.8
    return common if common != "y" and count.max() > lies * len(params) else None
