"""Store the figures of an evaluation, and write and read them as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from avatar.evaluation.input_protocol import InputProtocol
from avatar.metrics.speed import Speed
from avatar.metrics.surface_quality import SurfaceQuality, surface_spread
from avatar.metrics.view_quality import ViewQuality, mean_quality, spread_over_frames
from smplxpp.core.errors import InputError
from smplxpp.core.files import as_integer, as_number, as_object, as_text, atomic_write_text, jsonable, read_json
from smplxpp.metrics.pose_error import PoseError

SCHEMA = 1
_SUBJECT = "evaluation report"
SKINNING_ALONE = "skinning alone"
"""Name of the table row of the template after linear blend skinning, beside the models."""
PASSES: Mapping[str, str] = {
    "refined_poses": ", poses refined on training cameras",
    "followed_clothes": ", clothes from where they were followed",
}
"""Fields of a report with held-out poses that are measured once more, and what their titles add."""
SURFACE_SETS: Mapping[str, str] = {"training": "training frames", "held_out": "held-out frames"}


def view_key(camera: str, frame: int) -> str:
    """Return the name of a view in reports and files."""
    return f"{camera}_{frame:06d}"


@dataclass(frozen=True)
class ViewCounts:
    """Numbers of images, frames and cameras of a set of views."""

    images: int
    frames: int
    cameras: int


@dataclass(frozen=True)
class Surfaces:
    """Distances to the true surfaces of some frames, each frame's and their mean."""

    mean: SurfaceQuality
    frames: dict[int, SurfaceQuality]

    @property
    def spread(self) -> SurfaceQuality:
        """Standard deviations over the frames; None for fewer than two."""
        return surface_spread(list(self.frames.values()))


@dataclass(frozen=True)
class ModelFigures:
    """All figures that were measured on one model.

    Attributes:
        views: figures by set and view.
        surfaces: distances by part, "training" or "held_out"; parts without a true surface are left out.
        speed: None where it was not measured.
        parameters: number of parameters by part of the model, and "total".
        bytes: size of the model's file; None without one.
    """

    views: dict[str, dict[str, ViewQuality]] = field(default_factory=dict)
    surfaces: dict[str, Surfaces] = field(default_factory=dict)
    speed: Speed | None = None
    parameters: dict[str, int] = field(default_factory=dict)
    bytes: int | None = None

    def mean(self, name: str) -> dict[str, float]:
        """Return the means of a set's figures over the views that have them; none for a set that was not measured."""
        return mean_quality(self.views.get(name, {}))

    def spread(self, name: str) -> dict[str, float]:
        """Return the standard deviations over frames of a set's figures, each the mean over a frame's cameras."""
        # Cameras of one frame see the same pose, so that their errors are not independent: first their mean, then the
        # standard deviation over frames.
        by_frame: dict[str, dict[str, ViewQuality]] = {}
        for key, quality in self.views.get(name, {}).items():
            camera, frame = key.rsplit("_", 1)
            by_frame.setdefault(frame, {})[camera] = quality
        return spread_over_frames(by_frame.values())

    def counts(self, name: str) -> ViewCounts:
        """Return the numbers of images, frames and cameras of a set."""
        cameras, frames = ({key.rsplit("_", 1)[k] for key in self.views.get(name, {})} for k in (0, 1))
        return ViewCounts(len(self.views.get(name, {})), len(frames), len(cameras))


@dataclass(frozen=True)
class EvalReport:
    """An evaluation of models on a capture.

    Attributes:
        capture: name of the capture.
        metric: name of the perceptual distance; None without one.
        lpips: name of LPIPS and its backbone, where it was measured beside `metric`; None without it.
        models: figures by name, in the order of tables.
        skinning_alone: distances of the skinned template, as `ModelFigures.surfaces`.
        conventions: definitions of the figures, in words.
        inputs: origin of the inputs, as far as it is known.
        refined_poses: figures of held-out frames whose poses were refined on the training cameras' photographs; in
            `models` their poses are the tracker's.
        followed_clothes: figures of students in held-out poses with simulated clothes that start where the surface was
            followed in the training frames before; in `models` they start cold.
        poses: errors of the poses in use, by frames ("training frames" ...), where the exact poses are known.
    """

    capture: str
    metric: str | None
    models: dict[str, ModelFigures]
    skinning_alone: dict[str, Surfaces] = field(default_factory=dict)
    conventions: dict[str, str] = field(default_factory=dict)
    inputs: InputProtocol = field(default_factory=InputProtocol)
    refined_poses: dict[str, ModelFigures] = field(default_factory=dict)
    followed_clothes: dict[str, ModelFigures] = field(default_factory=dict)
    poses: dict[str, PoseError] = field(default_factory=dict)
    lpips: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the content of the JSON, with counts, means and spreads; infinite figures become null."""
        # Means, spreads and counts are written for readers of the file; `from_dict` computes them from the views again.
        out = jsonable(self)
        out["inputs"]["name"] = self.inputs.name
        for key in ("models", *PASSES):
            for name, model in getattr(self, key).items():
                for what in ("mean", "spread", "counts"):
                    out[key][name][what] = jsonable({part: getattr(model, what)(part) for part in model.views})
                _add_spreads(out[key][name]["surfaces"], model.surfaces)
        _add_spreads(out["skinning_alone"], self.skinning_alone)
        return {"schema": SCHEMA, **out}

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> EvalReport:
        """Return the report of an `as_dict`; older files, without counts and inputs, are read too.

        Raises:
            InputError: another schema, or content that does not fit it.
        """
        # Reports of another schema may have other figures under the same names.
        if values.get("schema") != SCHEMA:
            raise InputError(
                "evaluation report",
                expected=f"schema {SCHEMA}",
                received=str(values.get("schema")),
                remedy="evaluate again with this version",
            )
        # Reading by keys: whatever is missing or of another type ends in one error that names the schema.
        try:
            return EvalReport(
                capture=as_text(values["capture"], subject=f"{_SUBJECT}: capture"),
                metric=None if values["metric"] is None else as_text(values["metric"], subject=f"{_SUBJECT}: metric"),
                models={name: _model(model) for name, model in values["models"].items()},
                skinning_alone=_surfaces(values["skinning_alone"]),
                conventions=_texts(values["conventions"]),
                inputs=InputProtocol.from_dict(values.get("inputs", {})),
                **{key: {name: _model(model) for name, model in values.get(key, {}).items()} for key in PASSES},
                poses={name: _pose(error) for name, error in values.get("poses", {}).items()},
                lpips=None if values.get("lpips") is None else as_text(values["lpips"], subject=f"{_SUBJECT}: lpips"),
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                "evaluation report",
                expected=f"the content of schema {SCHEMA}",
                received=f"{type(error).__name__}: {error}",
                remedy="evaluate again with this version",
            ) from None

    def save(self, path: Path) -> None:
        """Write the report as JSON, whole or not at all."""
        atomic_write_text(path, json.dumps(self.as_dict(), indent=1))

    @staticmethod
    def load(path: Path) -> EvalReport:
        """Read a report that `save` wrote, with checks.

        Raises:
            InputError: missing, damaged or foreign file.
        """
        values = read_json(path, subject="evaluation report", remedy="evaluate again with this version")
        return EvalReport.from_dict(as_object(values, subject=f"evaluation report {path}"))


def _model(values: Mapping[str, Any]) -> ModelFigures:
    return ModelFigures(
        views={
            part: {_view(key): _quality(view) for key, view in views.items()} for part, views in values["views"].items()
        },
        surfaces=_surfaces(values["surfaces"]),
        speed=None if values["speed"] is None else _speed(values["speed"]),
        parameters={
            name: as_integer(count, subject=f"{_SUBJECT}: parameters", least=0)
            for name, count in values["parameters"].items()
        },
        bytes=None if values["bytes"] is None else as_integer(values["bytes"], subject=f"{_SUBJECT}: bytes", least=0),
    )


def _view(key: str) -> str:
    """Return the name of a view, checked to be one of `view_key`."""
    camera, _, frame = key.rpartition("_")
    if not camera or not frame.isdecimal():
        raise InputError(f"{_SUBJECT}: view", expected="CAMERA_FRAME", received=repr(key[:80]))
    return key


def _texts(values: Mapping[str, Any]) -> dict[str, str]:
    return {name: as_text(value, subject=f"{_SUBJECT}: {name}") for name, value in values.items()}


def _speed(values: Mapping[str, Any]) -> Speed:
    _require_figures({name: value for name, value in values.items() if name != "device"})
    as_text(values["device"], subject=f"{_SUBJECT}: device")
    return Speed(**values)


def _pose(values: Mapping[str, Any]) -> PoseError:
    # A group without vertices has no distance: null in the file.
    figures = {name: float("nan") if value is None else value for name, value in values.items() if name != "frames"}
    _require_figures(figures, finite=False)
    return PoseError(frames=int(values["frames"]), **figures)


def _quality(values: Mapping[str, Any]) -> ViewQuality:
    # Every view has these two figures, so that a null means an infinite PSNR.
    _require_figures(values)
    return ViewQuality(**{**values, **{k: float("inf") for k in ("psnr", "psnr_image") if values[k] is None}})


def _surfaces(values: Mapping[str, Any]) -> dict[str, Surfaces]:
    return {
        name: Surfaces(_surface(one["mean"]), {int(frame): _surface(q) for frame, q in one["frames"].items()})
        for name, one in values.items()
    }


def _surface(values: Mapping[str, Any]) -> SurfaceQuality:
    # The labels of a surface have the same figures as the surface itself, hence the recursion.
    figures = {name: value for name, value in values.items() if name != "labels"}
    _require_figures(figures)
    return SurfaceQuality(**figures, labels={name: _surface(part) for name, part in values["labels"].items()})


def _require_figures(values: Mapping[str, Any], *, finite: bool = True) -> None:
    """Raise `InputError` for a figure that is neither a number nor null."""
    for name, value in values.items():
        if value is not None and not (not finite and isinstance(value, float)):
            as_number(value, subject=f"{_SUBJECT}: {name}")


def _add_spreads(out: dict[str, Any], surfaces: Mapping[str, Surfaces]) -> None:
    for name, one in surfaces.items():
        out[name]["spread"] = jsonable(one.spread)
