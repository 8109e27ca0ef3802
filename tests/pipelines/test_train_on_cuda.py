"""`smplxpp train` and `evaluate` on CUDA, pretended: no stage of the preset "demo" mixes it with the CPU."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from avatar.evaluation.evaluate import EvaluationConfig
from avatar.evaluation.protocol import ProtocolConfig
from avatar.training.presets import TRAINING_PRESETS
from avatar.training.student import compensate
from avatar.training.tracking import track
from pipelines.ablation.ablate import AblationRun, ablate
from pipelines.ablation.rows import ablation_rows
from pipelines.cli import main
from pipelines.runs.layout import PARAMS, TEMPLATE
from pipelines.runs.stage import read_manifest
from pipelines.stages.build_config import BuildConfig, BuildInputs, save_build
from pipelines.stages.scene import TrainInputs
from smplxpp.template.template import Template
from tests.cloth.persons import PART, person, standing
from tests.dolls.dancing import write_dance, write_dance_run
from tests.dolls.skirted import write_skirted
from tests.dolls.tiny import tiny_preset
from tests.pipelines.training_runs import QUICK, few_trials
from tests.pretended_cuda import PretendedTensor, pretended_cuda

SELDOM = {"evaluations": 1, "evaluated": 1}
DEMO = replace(
    QUICK,
    teacher=replace(QUICK.teacher, **SELDOM),
    bake=replace(QUICK.bake, **SELDOM),
    compensate=replace(QUICK.compensate, **SELDOM),
)
FEW = ("--gaussians", "200", "--iterations-share", "0.008", "--no-report", "--json")
EVALUATED = "--metric none --samples 200 --every 9 --speed-pictures 1 --speed-size 24 32 --no-report".split()
MEASURED = EvaluationConfig(
    protocol=ProtocolConfig(every=9, sets=("novel_view",)), metric="none", samples=200, speed_pictures=0, shown=0
)


def on_cuda(command: str, run: Path, capture: Path, *options: str) -> None:
    with pretended_cuda(), few_trials(), mock.patch.dict(TRAINING_PRESETS, demo=DEMO):
        assert main([command, str(run), *_told(capture), *options]) == 0


def _told(capture: Path) -> tuple[str, ...]:
    return ("--capture", str(capture), "--device", "cuda")


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    monkeypatch.setattr(compensate, "_fit", partial(compensate._fit, steps=2))


@pytest.fixture(scope="module")
def dance(tmp_path_factory) -> Path:
    return write_dance(tmp_path_factory.mktemp("captures") / "dance")


def smiling() -> Template:
    """The person in a skirt, with expressions."""
    made = person()
    some = np.random.default_rng(0).normal(size=(made.body.vertex_count, 3, 2))
    return replace(made, body=replace(made.body, exprdirs=0.002 * some))


# A skirt that few steps have tracked hangs on edges at the limit of what holds.
@pytest.mark.filterwarnings("ignore:simulated clothes:smplxpp.core.errors.GeometryWarning")
@pytest.mark.long
def test_every_stage_with_loose_clothes_and_their_evaluation(tmp_path, monkeypatch):
    run, capture = tmp_path / "run", write_skirted(tmp_path / "skirted")
    for path in (TEMPLATE, PARAMS):
        (run / path).parent.mkdir(parents=True)
    smiling().save(run / TEMPLATE)
    standing().save(run / PARAMS)
    save_build(run, BuildInputs("skirted", capture / "scan.ply", capture / "params" / "000000.npz"), BuildConfig())
    foreseen = _kept(monkeypatch)
    on_cuda("train", run, capture, "--preset", "demo", *FEW, "--loose-parts", PART)
    assert [type(one.share) for one in foreseen] == [PretendedTensor]  # the skirt was simulated for the tracking
    for stage in ("70_fit", "80_teacher", "83_cloth", "85_bake", "90_compensate"):
        manifest = read_manifest(run / stage)
        assert manifest["config"]["device"] == "cuda" and manifest["numbers"]["finished"]
    assert read_manifest(run / "83_cloth")["numbers"]["loose"] == [PART]
    with pretended_cuda():
        assert main(["evaluate", str(run), *_told(capture), *EVALUATED]) == 0
    manifest = read_manifest(run / "95_evaluate")
    assert manifest["config"]["cloth"] == "simulate" and manifest["config"]["device"] == "cuda"
    assert list(manifest["numbers"]["models"]) == ["fit", "teacher", "student"]


def _kept(monkeypatch) -> list:
    """What simulations of the tracking will give."""
    found: list = []
    simulate: Callable = track.simulate_controls

    def keeping(*arguments, **named):
        found.append(simulate(*arguments, **named))
        return found[-1]

    monkeypatch.setattr(track, "simulate_controls", keeping)
    return found


def test_a_surface_is_followed_without_simulation_and_trainings_go_on(dance, tmp_path, capsys):
    """And what the pretended device cannot have, networks as graphs, is said and left out."""
    run = write_dance_run(tmp_path / "run")
    until = (
        "--preset",
        "demo",
        *FEW,
        "--until",
        "teacher",
        "--compile",
        "graphs",
        "--readers",
        "2",
        "--cache-gib",
        "0",
    )
    on_cuda("train", run, dance, *until, "--max-minutes", "1e-9")
    assert not json.loads(capsys.readouterr().out)["finished"]
    on_cuda("train", run, dance, *until)
    assert read_manifest(run / "80_teacher")["numbers"]["finished"]


@pytest.mark.long
def test_baselines_are_trained_and_measured(dance, tmp_path):
    run, rows = write_dance_run(tmp_path / "run"), ("mlp", "uv", "mesh")
    with pretended_cuda():
        outcome = ablate(
            run, TrainInputs(dance), ablation_rows(rows), tiny_preset(1), MEASURED, AblationRun(device="cuda")
        )
    assert list(outcome.results["rows"]) == list(rows) and outcome.waiting == []
