"""Options of a motion that drives a person, and how it is read for that person's body."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.commands.options import OptionalPath
from pipelines.runs.layout import TEMPLATE
from smplxpp.body import BodyModel, load_body, load_params
from smplxpp.body.bvh_params import load_bvh, read_joint_map
from smplxpp.body.importers import UpAxis
from smplxpp.body.retarget import Skeleton, retarget
from smplxpp.cloth.poses import resampled
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template

BVH = ".bvh"
OPEN = "open"


@dataclass(frozen=True)
class Driving:
    """Options of a motion."""

    retarget_from: OptionalPath = None
    """Body that the motion is of, where it is another's: a body model file (the motion's betas are its shape), a run,
    or `open`. Ways are then in proportion to the legs, and feet that stand do not slide. A .bvh has its own."""
    joint_map: OptionalPath = None
    """JSON of a .bvh's joints with unusual names, {"LeftUpLeg": "left_hip", ...}."""
    up: UpAxis | None = None
    """Axis that points up in the motion (AMASS: z); a .bvh tells it by its skeleton."""

    def load(self, path: Path, body: BodyModel) -> BodyParams:
        """Read a motion for a body; in frames of a file that hold NaN stand poses in between.

        Raises:
            InputError: no motion, one of another body, joints without a name that is known.

        Warns:
            GeometryWarning: frames that hold NaN or infinity.
        """
        if path.suffix.lower() == BVH:
            self._refuse("retarget-from", self.retarget_from, f"{path}, which has a skeleton of its own")
            self._refuse("up", self.up, f"{path}, which tells it by its skeleton")
            names = None if self.joint_map is None else read_joint_map(self.joint_map)
            return load_bvh(path, Skeleton.of(body), joint_map=names)
        self._refuse("joint-map", self.joint_map, f"{path}, whose joints have SMPL's names")
        if self.retarget_from is None:
            return _whole(path, body, self.up)
        source, shaped = self._source()
        params = _whole(path, source, self.up)
        betas = params.betas[0] if shaped else None
        return retarget(params, Skeleton.of(source, betas), Skeleton.of(body))

    def _source(self) -> tuple[BodyModel, bool]:
        """The body of the motion, and whether the motion's betas give it its shape."""
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


def _whole(path: Path, body: BodyModel, up: UpAxis | None) -> BodyParams:
    """Read a motion whose frames without a pose get the ones between their neighbours', or the nearest at its ends."""
    holes: list[int] = []
    params = load_params(path, body=body, up=up, holes=holes)
    if not holes:
        return params
    count = len(params)
    warnings.warn(
        f"{path}: {len(holes)} of {count} frames hold NaN or infinity, the first {holes[0]}: poses between those "
        "before and behind stand there",
        GeometryWarning,
        stacklevel=3,
    )
    known = np.setdiff1d(np.arange(count), holes)
    times = known.astype(np.float64)
    between = resampled(params.select(known), times, np.clip(np.arange(float(count)), times[0], times[-1]))
    rows = np.arange(count)
    rows[holes] += count
    return BodyParams.concatenate([params, between]).select(rows)


def unshaped(body: BodyModel) -> BodyModel:
    """A template's body, whose identity is in its mean shape: betas of a file do not move its joints once more."""
    return replace(body, shapedirs=np.zeros_like(body.shapedirs))
