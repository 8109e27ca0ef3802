"""The doors of a run: templates, body models, networks, Gaussians, and what stages say of themselves."""

from __future__ import annotations

import json
import warnings
from functools import cache, partial
from pathlib import Path

import numpy as np

from avatar.evaluation.report import EvalReport, ModelFigures
from avatar.formats.ply import read_splat_ply, write_splat_ply
from avatar.gaussians.tensor_file import load_bound, save_bound
from avatar.models.model_file import load_avatar, save_avatar
from avatar.rig.rig import Rig
from avatar.training.engine.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from avatar.training.engine.metrics_log import read_metrics
from pipelines.batch.jobs import read_jobs
from pipelines.batch.records import Batch, JobRecord, read_batch, records_of, save_batch, save_job
from pipelines.commands.inspect import summarise_run
from pipelines.report import Report, write_report
from pipelines.report.builder import readable
from pipelines.report.sections.fit import fit_section
from pipelines.report.sections.training import refine_section
from pipelines.runs.artefacts import load_arrays, save_arrays
from pipelines.runs.layout import BUILD_STAGES, FIT_STAGE, REFINE_STAGE
from pipelines.runs.stage import StageOutput, StageRecord, read_manifest, run_stage
from pipelines.stages.build_config import (
    BuildConfig,
    BuildInputs,
    ReconstructInputs,
    RegisterInputs,
    load_build,
    load_reconstruct,
    load_register,
    save_build,
    save_reconstruct,
    save_register,
)
from smplxpp.body import load_body
from smplxpp.build.reconstruct import unit_cube_of
from smplxpp.cloth.garment_file import load_garments, save_garments
from smplxpp.core import Check, GeometryWarning
from smplxpp.template import Template
from tests.cloth.persons import person
from tests.cloth.test_driver import garment
from tests.dolls.dancing import gaussians, template
from tests.formats.test_ply import random_splats
from tests.fuzz.examine import Door
from tests.models.test_model_file import make
from tests.pipelines.test_evaluation_gates import surfaces, view
from tests.runs.stages import stage_of
from tests.runtime.bundles import play_dressed, write_dressed

_VERTICES, _JOINTS = 60, 24


def _write_body(path: Path) -> None:
    """A body in SMPL's layout with few vertices."""
    rng = np.random.default_rng(0)
    weights, regressor = rng.random((_VERTICES, _JOINTS)), rng.random((_JOINTS, _VERTICES))
    parents = np.maximum(np.arange(_JOINTS) - 1, 0)
    parents[0] = 2**32 - 1
    np.savez(
        path,
        v_template=rng.random((_VERTICES, 3)),
        f=rng.integers(0, _VERTICES, (100, 3)),
        shapedirs=rng.random((_VERTICES, 3, 10)) * 0.01,
        posedirs=rng.random((_VERTICES, 3, 9 * (_JOINTS - 1))) * 0.01,
        weights=weights / weights.sum(axis=1, keepdims=True),
        J_regressor=regressor / regressor.sum(axis=1, keepdims=True),
        kintree_table=np.stack([parents, np.arange(_JOINTS)]),
    )


def _report() -> EvalReport:
    models = {"student": ModelFigures({"novel_view": {"Cam0_0": view(25.0)}}, surfaces(2.0))}
    return EvalReport("doll", None, models, skinning_alone=surfaces(1.0))


@cache
def _rig() -> Rig:
    return Rig(template())


def _checkpoint(path: Path) -> None:
    tensors = {name: value.detach() for name, value in make("student", _rig()).state_dict().items()}
    save_checkpoint(path, Checkpoint(7, 1.5, "key", tensors))


def _write_run(run: Path) -> None:
    def work(folder: Path) -> StageOutput:
        (folder / "data.bin").write_bytes(bytes(100))
        return StageOutput(checks=[Check("mean error", 0.5, "mm", 1, 2)])

    for name in BUILD_STAGES[:3]:
        run_stage(run, stage_of(name), work)
    for name, numbers in ((FIT_STAGE, _FIT), (REFINE_STAGE, _REFINED)):
        run_stage(run, stage_of(name), lambda folder, numbers=numbers: StageOutput(numbers=numbers))
    (run / "metrics.json").write_text(json.dumps({"schema": 1, "subject": "Dancer", "checks": []}))
    inputs = BuildInputs(scan=run / "scan.ply", params=run / "params.npz", subject="Dancer")
    save_build(run, inputs, BuildConfig())
    save_register(run, RegisterInputs(capture=run))
    save_reconstruct(run, ReconstructInputs(run, (0, 3), hold_out=("Cam1",), cell_mm=5.0))


_FIT = {
    "held_out": {"Cam1": {"psnr": 30.0, "psnr_image": 33.0, "ssim": 0.97, "psnr_head": 29.0}},
    "train": {},
    "mean": {"held_out": {"psnr": 30.0, "psnr_image": 33.0, "ssim": 0.97, "psnr_head": 29.0}},
    "heads": {"Cam1": [1, 2, 3, 4]},
    "convention": "words",
    **{"gaussians": 800, "iterations": 4, "iterations_done": 4, "seconds_of_steps": 2.0, "iterations_per_second": 2.0},
}
_REFINED = {
    "training": {
        **{name: [0.1, 0.2] for name in ("loss_before", "loss_after", "turned_degrees", "moved_mm")},
        **{"frames": [0, 3], "kept": [3], "joints": {"knee": 1.5}},
    },
    "pictures": [],
}


def _open_run(run: Path) -> None:
    summarise_run(run)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # what cannot be read is said
        sections = []
        for name, make in ((FIT_STAGE, fit_section), (REFINE_STAGE, refine_section)):
            manifest = read_manifest(run / name)
            if manifest is not None:
                record = StageRecord(run / name, manifest, ran=False)
                sections.append(readable(record, name, partial(make, record)))
    write_report(run / "report.html", Report("Dancer", sections=tuple(sections)))
    load_build(run)
    load_register(run)
    load_reconstruct(run)


def _model_door(kind: str, *, compact: bool = False) -> Door:
    return Door(
        f"model {kind}{' compact' if compact else ''}",
        lambda folder: save_avatar(folder / "m.safetensors", make(kind, _rig()), compact=compact),
        lambda folder: load_avatar(folder / "m.safetensors", _rig()),
    )


def _write_batch(folder: Path) -> None:
    """A job file, the record of its batch and that of one subject."""
    path, entries = folder / "jobs.yaml", "train: {preset: gpu, loose_parts: [upper]}, resources: {gpus: 0.5}"
    path.write_text(
        f"out: runs\ndefaults: {{steps: [build, train]}}\njobs:\n  - {{subject: a, capture: c, {entries}}}\n"
    )
    file = read_jobs(path)
    save_batch(file.out, Batch.of(file, path, key="a" * 64))
    record = JobRecord.of(file.jobs[0])
    record.steps[0].error = {"message": "scan: expected a person", "checks": ["P2S"]}
    save_job(file.out, record)


def _open_batch(folder: Path) -> None:
    """What a start, `batch status` and the page read."""
    file = read_jobs(folder / "jobs.yaml")
    for record in records_of(folder / "runs", read_batch(folder / "runs")):
        record.settle()
    for job in file.jobs:
        _ = [job.command(step, folder, job.capture) for step in job.steps]


def run_doors() -> list[Door]:
    """Doors that `avatar` and `pipelines` have."""
    lines = [{"iteration": k, "loss": 1.0 / (k + 1), "psnr": 20.0 + k} for k in range(6)]
    groups = {"scan": {"vertices": np.zeros((3, 3)), "faces": np.array([[0, 1, 2]])}, "hair": {"label": np.arange(3)}}
    return [
        Door("body npz", lambda folder: _write_body(folder / "b.npz"), lambda folder: load_body(folder / "b.npz")),
        Door("avatar bundle", write_dressed, lambda folder: play_dressed(folder / "me.avatar")),
        Door(
            "garments",
            lambda folder: save_garments(folder / "g.npz", [garment()]),
            lambda folder: [one.model() for one in load_garments(folder / "g.npz", person())],
        ),
        Door("template", lambda folder: template().save(folder / "t.npz"), lambda f: Template.load(f / "t.npz")),
        *(_model_door(kind) for kind in ("teacher", "tracked", "student", "shapes")),
        _model_door("shapes", compact=True),
        Door(
            "gaussians",
            lambda folder: save_bound(gaussians(60), folder / "g.safetensors"),
            lambda folder: load_bound(folder / "g.safetensors", faces=template().faces),
        ),
        Door(
            "checkpoint",
            lambda folder: _checkpoint(folder / "c.safetensors"),
            lambda folder: load_checkpoint(folder / "c.safetensors", key="key"),
            refuses=False,
        ),
        Door(
            "metrics log",
            lambda folder: (folder / "m.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n"),
            lambda folder: read_metrics(folder / "m.jsonl"),
            refuses=False,
        ),
        Door(
            "evaluation",
            lambda folder: _report().save(folder / "m.json"),
            lambda folder: EvalReport.load(folder / "m.json"),
        ),
        Door("stage arrays", lambda f: save_arrays(f / "a.npz", groups), lambda f: load_arrays(f / "a.npz")),
        Door(
            "unit cube",
            lambda folder: (folder / "transform.json").write_text(json.dumps({"scale": 0.5, "offset": [0.5] * 3})),
            unit_cube_of,
        ),
        Door("run", _write_run, _open_run, ("**/*.json",), refuses=False),
        Door("batch", _write_batch, _open_batch, ("**/*.json", "*.yaml")),
        Door(
            "splats",
            lambda folder: write_splat_ply(folder / "s.ply", random_splats()),
            lambda folder: read_splat_ply(folder / "s.ply"),
        ),
    ]
