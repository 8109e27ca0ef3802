"""Trainings of a few steps for the tests of `smplxpp train`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest import mock

from avatar.models.networks.teacher import NetworkPreset
from avatar.training import recipe
from avatar.training.loose_clothes import ClothConfig
from avatar.training.presets import TRAINING_PRESETS
from avatar.training.student import compensate, regress_poses
from avatar.training.tracking.config import Level, TrackConfig
from pipelines.cli import main
from smplxpp.cloth.calibrate import CalibrationConfig
from tests.dolls.tiny import TINY_FIELD, TINY_TEACHER

STAGES = ("80_teacher", "85_bake", "90_compensate")
SMALL = (
    "--preset",
    "demo",
    "--gaussians",
    "300",
    "--fit-iterations",
    "2",
    "--teacher-iterations",
    "3",
    "--bake-iterations",
    "3",
    "--compensate-iterations",
    "3",
    "--device",
    "cpu",
    "--json",
    "--no-report",
)
DEMO = TRAINING_PRESETS["demo"]
QUICK = replace(
    DEMO,
    networks=NetworkPreset(TINY_TEACHER, TINY_FIELD),
    teacher=replace(DEMO.teacher, track=TrackConfig(levels=(Level(1, 2, 2e-3),), control_points=24)),
    bake=replace(DEMO.bake, pretrain=replace(DEMO.bake.pretrain, iterations=170)),  # two of three steps
)


# Two of the ten simulations that choose how cloth hangs, a tenth of the fits that choose how poses are regressed.
CALIBRATION = CalibrationConfig(drags=(1.25, 2.5), pin_depths=(0.014,))
REGRESSION = regress_poses.RegressionConfig(blocks=3, fades=(0.5,), reaches=(0.0, 0.02))


@contextmanager
def few_trials() -> Iterator[None]:
    """Within the block trainings choose among few values of what they search over grids."""
    regression = partial(regress_poses.fit_pose_regression, config=REGRESSION)
    with (
        mock.patch.object(regress_poses, "fit_pose_regression", regression),
        mock.patch.object(recipe, "ClothConfig", partial(ClothConfig, calibration=CALIBRATION)),
    ):
        yield


@contextmanager
def quick() -> Iterator[None]:
    """Tiny networks as the preset "demo", whose blend shapes start from a fit of a thirtieth of its steps."""
    with (
        few_trials(),
        mock.patch.dict(TRAINING_PRESETS, demo=QUICK),
        mock.patch.object(compensate, "_fit", partial(compensate._fit, steps=20)),
    ):
        yield


def train(run: Path, capture: Path, *options: str) -> int:
    """The command, with tiny networks as the preset "demo"."""
    with quick():
        return main(["train", str(run), "--capture", str(capture), *SMALL, *options])


def refused(capsys, run: Path, capture: Path, *options: str) -> str:
    """The message of a training that must be refused before anything is written."""
    before = sorted(run.rglob("*")) if run.exists() else []
    assert train(run, capture, *options) == 2
    message = json.loads(capsys.readouterr().out)["error"]["message"]
    assert (sorted(run.rglob("*")) if run.exists() else []) == before
    return message


def same_models(one: Path, two: Path) -> bool:
    """Whether two runs hold the same models, byte for byte."""
    files = sorted(path.relative_to(one) for stage in STAGES for path in (one / stage).glob("*.safetensors"))
    assert len(files) == 4
    return all((one / file).read_bytes() == (two / file).read_bytes() for file in files)


def often(monkeypatch) -> None:
    """A checkpoint after every step."""
    from avatar.training.engine import loop

    init = loop.LoopConfig.__init__

    def changed(self, **values):
        init(self, **{**values, "checkpoint_seconds": 0.0})

    monkeypatch.setattr(loop.LoopConfig, "__init__", changed)
