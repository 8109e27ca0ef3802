"""Rows that are trained and measured: what they claim to be, what they share, where they go on, what they take over."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.evaluation.evaluate import EvaluationConfig
from avatar.evaluation.protocol import AsNew, ProtocolConfig
from avatar.evaluation.report import EvalReport
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.training.engine.processes import Distributed
from avatar.training.recipe import Recipe
from pipelines.ablation import measure
from pipelines.ablation.ablate import AblationRun, ablate
from pipelines.ablation.rows import PAPER_ROWS, PRUNED_SHARE, ablation_rows, ablation_stages
from pipelines.runs.stage import read_manifest
from pipelines.stages.models import Trainer, TrainOptions
from pipelines.stages.scene import TrainInputs, open_scene
from pipelines.stages.train import train
from tests.dolls.swaying import write_moving_capture, write_moving_run
from tests.dolls.tiny import tiny_preset

pytestmark = pytest.mark.long

MEASURED = EvaluationConfig(
    protocol=ProtocolConfig(every=2, sets=("novel_view", "novel_pose")),
    metric="none",
    samples=0,
    speed_pictures=0,
    shown=1,
)
SURFACE = replace(MEASURED, protocol=ProtocolConfig(every=9, sets=("novel_view",)), samples=500)
"""One frame: what can be seen of a mesh is found in many renderings."""
SHARED = {"gaussians", "teacher", "cloth", "bake", "full"}


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_moving_capture(tmp_path_factory.mktemp("doll") / "capture")


def ablated(run, capture, rows, *, iterations: int = 3, config: EvaluationConfig = MEASURED, **how):
    return ablate(run, TrainInputs(capture), ablation_rows(rows), tiny_preset(iterations), config, AblationRun(**how))


def opened(run, capture, iterations: int = 3):
    """A trainer of the run, and the stages of its ablation."""
    scene = open_scene(run, TrainInputs(capture))
    trainer = Trainer(run, scene, TrainOptions(), Distributed())
    return trainer, ablation_stages(tiny_preset(iterations), training_frames=len(scene.capture.splits.train_frames))


def made(run) -> dict[str, int]:
    """When each stage of an ablation was made."""
    manifests = (run / "ablation").rglob("manifest.json")
    return {path.parent.relative_to(run / "ablation").as_posix(): path.stat().st_mtime_ns for path in manifests}


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory):
    """The paper's rows, trained and measured."""
    run = write_moving_run(tmp_path_factory.mktemp("ablation") / "run")
    return run, ablated(run, capture, ("paper",))


@pytest.fixture
def own(finished, tmp_path):
    """A copy of the finished rows to work on."""
    return shutil.copytree(finished[0], tmp_path / "run")


def test_trained_rows_are_what_they_claim(finished, capture):
    run, outcome = finished
    assert list(outcome.results["rows"]) == list(PAPER_ROWS) and outcome.waiting == []
    trainer, stages = opened(run, capture)
    camera_centers, pose = torch.tensor([[0.0, 0.5, 2.0]]), trainer.sequence("clothed").pose(1)
    models = {name: trainer.model(stages[row.model]) for name, row in PAPER_ROWS.items()}
    with torch.no_grad():
        posed = {name: models[name](pose, camera_centers) for name in ("no-mesh", "no-gaussians", "full", "no-teacher")}
    assert posed["no-mesh"].displacements is None
    assert models["no-mesh"].blend_shapes is not None
    assert models["no-gaussians"].blend_shapes is None and posed["no-gaussians"].displacements is not None
    # The compensation leaves the mesh as the bake made it.
    assert torch.equal(posed["full"].vertices, posed["no-gaussians"].vertices)
    assert not torch.equal(posed["no-teacher"].vertices, posed["full"].vertices)
    assert models["naked"].rig.template.part_names == ("body",)
    assert isinstance(trainer.model(stages["teacher"]), TeacherAvatar)


def test_shared_stages_are_trained_once_and_leave_no_state(finished):
    run, _ = finished
    rest = {"no_field_bake", "no_field", "no_teacher_bake", "no_teacher"}
    naked = {"naked_gaussians", "naked_teacher", "naked_bake", "naked"}
    assert set(made(run)) == SHARED | rest | naked | {f"rows/{name}" for name in PAPER_ROWS}
    assert not list(run.rglob("state.safetensors")) and not list(run.rglob("*_work"))


def test_figures_of_every_row(finished):
    table = finished[1].table
    assert list(table.rows) == [row.title for row in PAPER_ROWS.values()]
    for title, figures in table.rows.items():
        for key in ("novel_view.psnr", "novel_pose.ssim", "megabytes", "minutes", "iterations"):
            assert np.isfinite(figures[key]), (title, key)
    full, baked = table.rows["Full"], table.rows["w/o Gau Non."]
    assert full["megabytes"] > baked["megabytes"] and full["minutes"] > baked["minutes"]
    assert full["iterations"] == baked["iterations"] + 3
    assert "w/o Mesh Non." in table.text() and r"\toprule" in table.latex() and "novel_view.psnr" in table.csv()


def test_surfaces_are_those_of_the_posed_meshes(own, capture):
    outcome = ablated(own, capture, ("naked", "no-mesh"), config=SURFACE)
    naked, skinned = outcome.table.rows.values()
    report = EvalReport.load(own / "ablation" / "rows" / "no-mesh" / "report.json")
    assert skinned["surface.training.p2s"] == report.skinning_alone["training"].mean.p2s
    assert skinned["surface.training.lower.p2s"] > 0
    assert "surface.training.lower.p2s" not in naked and naked["surface.training.p2s"] > 0


def test_what_stands_is_not_done_again_and_what_is_gone_is(own, capture, finished):
    before = made(own)
    again = ablated(own, capture, ("paper",))
    assert again.results["rows"] == finished[1].results["rows"] and made(own) == before
    (own / "ablation" / "full" / "student.safetensors").unlink()
    assert ablated(own, capture, ("full",), max_seconds=1e-9).waiting == ["full"]
    ablated(own, capture, ("full",))
    assert {name for name, when in made(own).items() if before[name] != when} == {"full"}


def test_an_interrupted_ablation_ends_with_the_same_weights(finished, capture, tmp_path):
    run, whole = finished
    cut, calls = write_moving_run(tmp_path / "run"), 0
    while (part := ablated(cut, capture, ("full",), max_seconds=1e-3 if calls < 5 else np.inf)).waiting:
        assert part.results["rows"] == {} and part.waiting[-1] == "full"
        calls += 1
        assert calls < 40
    assert calls >= 5
    weights = [
        trainer.model(stages["full"]).state_dict() for trainer, stages in (opened(one, capture) for one in (run, cut))
    ]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())
    figures = [dict(one.results["rows"]["full"]["figures"]) for one in (whole, part)]
    timed = ("minutes",)
    assert {k: v for k, v in figures[0].items() if k not in timed} == {
        k: v for k, v in figures[1].items() if k not in timed
    }


def test_progress_is_told(capture, tmp_path):
    told: dict[str, list] = {"training": [], "measuring": []}
    ablated(
        write_moving_run(tmp_path / "run"),
        capture,
        ("lbs",),
        training=lambda name, progress: told["training"].append((name, progress.iterations)),
        measuring=lambda name, share: told["measuring"].append((name, share)),
    )
    assert {name for name, _ in told["training"]} == {"gaussians", "lbs"}
    assert max(total for name, total in told["training"] if name == "lbs") == 6  # of bake and compensation together
    assert told["measuring"][-1] == ("lbs", 1.0)


def test_a_pruned_student_is_smaller_and_the_null_codes_row_is_full_told_nothing(own, capture):
    rows = ablation_rows(("pruned", "null-code"))
    ablated(own, capture, tuple(rows))
    trainer, stages = opened(own, capture)
    student = trainer.model(stages["pruned"])
    assert len(student.blend_shapes.active) == round(PRUNED_SHARE * len(student.gaussians))
    reports = {name: EvalReport.load(own / "ablation" / "rows" / name / "report.json") for name in (*rows, "full")}
    bytes_of = {name: report.models[{**PAPER_ROWS, **rows}[name].title].bytes for name, report in reports.items()}
    assert bytes_of["pruned"] < bytes_of["null-code"] == bytes_of["full"]
    full, pose = trainer.model(stages["full"]), trainer.sequence("clothed").pose(1)
    camera_centers = torch.tensor([[0.0, 0.5, 2.0]])
    with torch.no_grad():
        full.codes.codes += 1.0  # three steps leave most of them at zero
        null, known = AsNew(full)(pose, camera_centers), full(pose, camera_centers)
        assert torch.equal(null.vertices, full(pose.without_code(), camera_centers).vertices)
    assert not torch.equal(null.vertices, known.vertices)


def test_force_trains_anew(own, capture):
    before = made(own)
    ablated(own, capture, ("no-gaussians",), force=True)
    anew = {name for name, when in made(own).items() if before[name] != when}
    assert anew == {"gaussians", "teacher", "cloth", "bake", "rows/no-gaussians"}


def test_what_a_training_made_is_taken_as_it_stands(capture, tmp_path, monkeypatch):
    run, inputs = write_moving_run(tmp_path / "run"), TrainInputs(capture)
    scene = open_scene(run, inputs)
    train(run, inputs, scene, Recipe(preset=tiny_preset(2)), TrainOptions(), Distributed())
    outcome = ablated(run, capture, ("full",), iterations=2)
    assert set(made(run)) == {"rows/full"} and outcome.waiting == []  # the row alone
    row = read_manifest(run / "ablation" / "rows" / "full")
    assert "90_compensate/student.safetensors" in row["inputs"]

    def taken(preset, *, inputs=inputs) -> list[str]:
        """Stages of the full system that need not be trained."""
        trainer = Trainer(run, open_scene(run, inputs), TrainOptions(), Distributed(), scale=inputs.scale)
        stages = ablation_stages(preset, training_frames=4)
        return [name for name in ("gaussians", "teacher", "bake", "full") if trainer.found(stages[name]) is not None]

    preset = tiny_preset(2)
    assert taken(preset) == ["gaussians", "teacher", "bake", "full"]
    assert taken(replace(preset, bake=replace(preset.bake, lr=1e-3))) == ["gaussians", "teacher"]
    fewer = replace(preset.fit, sampling=replace(preset.fit.sampling, count=400))
    assert taken(replace(preset, fit=fewer)) == []
    assert taken(replace(preset, blend_shapes=replace(preset.blend_shapes, body_shapes=4))) == [
        "gaussians",
        "teacher",
        "bake",
    ]
    assert taken(preset, inputs=replace(inputs, scale=0.5)) == []
    assert taken(preset, inputs=replace(inputs, hold_out=("Ring0",))) == []
    image = scene.capture.file("Ring0", scene.frame)
    before = image.read_bytes()
    image.write_bytes(before + b"other")
    assert taken(preset) == []
    image.write_bytes(before)


@pytest.mark.slow
def test_all_rows_of_the_options_and_baselines(capture, tmp_path):
    rows = ablation_rows(("options", "baselines"))
    outcome = ablated(write_moving_run(tmp_path / "run"), capture, tuple(rows), iterations=2)
    assert list(outcome.results["rows"]) == list(rows)
    assert all(np.isfinite(figures["novel_view.psnr"]) for figures in outcome.table.rows.values())
    json.dumps(outcome.results)
    assert measure.ROWS_FOLDER == "ablation/rows"
