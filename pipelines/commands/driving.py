"""Options of a motion that drives a person, and how it is read for that person's body."""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.commands.options import OptionalPath, OptionalText
from pipelines.runs.layout import TEMPLATE
from smplxpp.body import BodyModel, UpAxis, Whose, is_skeleton, load_body, load_motion
from smplxpp.body.motion_facts import skeleton_of_file
from smplxpp.body.retarget import Skeleton, retarget
from smplxpp.body.skeleton_params import MatchedSkeleton, load_skeleton, read_joint_map
from smplxpp.body.smpl_params import FAMILY_NAMES, retarget_smpl
from smplxpp.cloth.poses import resampled
from smplxpp.core import BodyParams, GeometryWarning, InputError, require_positive
from smplxpp.template.template import Template

log = logging.getLogger(__name__)

OPEN = "open"


@dataclass(frozen=True)
class Driving:
    """Options of a motion that drives an avatar."""

    retarget_from: OptionalPath = None
    """Body that the motion was recorded for, if it is another one: a body model file (with the motion's betas), a run,
    or `open`. The root translation is then scaled by leg length, and planted feet do not slide. A .bvh, .glb
    or .vrm has its own skeleton."""
    joint_map: OptionalPath = None
    """JSON of a skeleton's joints with unusual names, {"LeftUpLeg": "left_hip", ...}."""
    clip: OptionalText = None
    """Name of the motion, for a .glb or .vrm with several (default: the first)."""
    up: UpAxis | None = None
    """Axis that points up in the motion; by default the one that the file states, or z for AMASS, -y for TalkBody4D
    and y for others, and for a skeleton that along which it stands at rest."""
    whose: Whose = "auto"
    """Whose parameters they are. auto: as the file tells; turns of SMPL, SMPL-H and SMPL-X are brought to an avatar of
    the open body. body: the avatar's own, whatever they look like."""

    def load(self, path: Path, body: BodyModel, *, fps: float | None = None) -> BodyParams:
        """Read a motion for a body; frames with NaN get poses interpolated between their neighbours.

        Args:
            path: of the motion.
            body: body that shall move.
            fps: frames a second; None: as the file states, or `DEFAULT_FPS` with a warning.

        Raises:
            InputError: no motion, one of another body, joints without a name that is known.

        Warns:
            GeometryWarning: frames that hold NaN or infinity; a motion that states no rate.
        """
        if fps is not None:
            require_positive("option fps", fps)
        # Such a file contains a skeleton, so that options for it are refused instead of ignored.
        if is_skeleton(path):
            self._refuse("retarget-from", self.retarget_from, f"{path}, which has a skeleton of its own")
            self._refuse("whose", None if self.whose == "auto" else self.whose, f"{path}, which has a skeleton")
            names = None if self.joint_map is None else read_joint_map(self.joint_map)
            return load_skeleton(path, Skeleton.of(body), joint_map=names, up=self.up, fps=fps, clip=self.clip)
        self._refuse("joint-map", self.joint_map, f"{path}, whose joints have SMPL's names")
        self._refuse("clip", self.clip, f"{path}, which has one motion")
        if self.retarget_from is None:
            return _whole(path, body, self.up, self.whose, fps)
        # Read the motion for its own body, then transfer it to the person's skeleton. `open` says whose it is.
        source, shaped = self._source()
        params = _whole(path, source, self.up, "body" if self.whose == "auto" else self.whose, fps)
        betas = params.betas[0] if shaped else None
        return retarget(params, Skeleton.of(source, betas), Skeleton.of(body))

    def skeleton(self, path: Path) -> MatchedSkeleton:
        """Return which joints of a skeleton's file stand for the body's, and log them; raises what `load` raises."""
        names = None if self.joint_map is None else read_joint_map(self.joint_map)
        found = skeleton_of_file(path, joint_map=names, up=self.up, clip=self.clip)
        log.info("%s: %s", path, ", ".join(f"{ours} = {' + '.join(own)}" for ours, own in found.taken.items()))
        return found

    def _source(self) -> tuple[BodyModel, bool]:
        """Return the body of the motion, and whether the motion's betas give it its shape."""
        assert self.retarget_from is not None, "asked for"
        if str(self.retarget_from) == OPEN:
            return load_body(), True
        if not self.retarget_from.is_dir():
            return load_body(self.retarget_from), True
        path = self.retarget_from / TEMPLATE
        if not path.is_file():
            raise InputError(
                f"option retarget-from {self.retarget_from}", expected="a run with a template", received="none in it"
            )
        return unshaped(Template.load(path).body), False

    @staticmethod
    def _refuse(name: str, value: object, received: str) -> None:
        if value is not None:
            raise InputError(f"option {name}", expected="a motion that needs it", received=received)


def _whole(path: Path, body: BodyModel, up: UpAxis | None, whose: Whose, fps: float | None) -> BodyParams:
    """Read a motion for a body; frames without a pose get one between their neighbours."""
    params, family, invalid = load_motion(path, body, up=up, whose=whose)
    params = _interpolated(params.with_rate(fps, source=str(path)), invalid, path)
    if family is None:
        return params
    if whose == "auto":
        warnings.warn(
            f"{path}: a motion of {FAMILY_NAMES[family]}: its turns are brought to the open body's joints, its steps "
            "scaled by the legs. With its model's file (--retarget-from) its shape counts, too; if it is the open "
            "body's, say --whose body",
            GeometryWarning,
            stacklevel=3,
        )
    return retarget_smpl(params, family, Skeleton.of(body))


def _interpolated(params: BodyParams, invalid: list[int], path: Path) -> BodyParams:
    """Interpolate the poses of invalid frames between their neighbours; at the ends copy the nearest."""
    if not invalid:
        return params
    count = len(params)
    warnings.warn(
        f"{path}: {len(invalid)} of {count} frames hold NaN or infinity, the first {invalid[0]}: poses between those "
        "before and behind stand there",
        GeometryWarning,
        stacklevel=4,
    )
    # Interpolate at the invalid frames; times outside the known frames are clamped to the nearest one.
    known = np.setdiff1d(np.arange(count), invalid)
    times = known.astype(np.float64)
    between = resampled(params.select(known), times, np.clip(np.arange(float(count)), times[0], times[-1]))
    # Take row k of the motion, or of the interpolated copy (rows count to 2 count - 1) at an invalid frame.
    rows = np.arange(count)
    rows[invalid] += count
    return BodyParams.concatenate([params, between]).select(rows)


def unshaped(body: BodyModel) -> BodyModel:
    """Return a template's body without shape directions: its mean shape is the person's, so that betas must not act."""
    return replace(body, shapedirs=np.zeros_like(body.shapedirs))
