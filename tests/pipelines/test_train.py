"""`smplxpp train` from end to end on a doll that dances: files, figures, skipping, resuming."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from avatar.models.model_file import load_avatar
from avatar.rig.rig import Rig
from avatar.training.presets import TRAINING_PRESETS
from avatar.training.student.bake import BakeTask
from pipelines.batch import process
from pipelines.cli import main
from pipelines.commands.train import Train
from pipelines.runs.layout import TEMPLATE
from pipelines.runs.stage import read_manifest
from pipelines.stages import train as train_stage
from smplxpp.cloth.garment_file import load_garments
from smplxpp.core.errors import InputError
from smplxpp.figures.drawings import read_strip
from tests.cloth.persons import person
from tests.dolls.dancing import HELD_OUT, template, write_dance_run
from tests.dolls.skirted import write_skirted
from tests.pipelines import training_runs
from tests.pipelines.training_runs import QUICK, SMALL, STAGES, often, same_models, train

ROOT = Path(__file__).resolve().parents[2]
MODELS = {
    "80_teacher": {"teacher.safetensors"},
    "85_bake": {"student.safetensors"},
    "90_compensate": {"student.safetensors", "student_compact.safetensors"},
}


@pytest.fixture(scope="module")
def capture(danced):
    return danced[0]


@pytest.fixture(scope="module")
def trained(danced):
    return danced[1]


@pytest.fixture
def own(trained, tmp_path):
    """A copy of the trained run to change."""
    return shutil.copytree(trained, tmp_path / "run")


@pytest.fixture
def fitted(trained, tmp_path):
    """A run with the fit alone."""
    run = write_dance_run(tmp_path / "run")
    shutil.copytree(trained / "70_fit", run / "70_fit")
    return run


@pytest.mark.parametrize("stage", STAGES)
def test_files_and_figures_of_every_stage(trained, stage):
    folder = trained / stage
    previews = {f"previews/Held0_{frame:06d}.png" for frame in (1, 3, 4, 5)}
    files = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    before = {"80_teacher": {"track_metrics.jsonl", "pretrain_metrics.jsonl"}, "85_bake": {"pretrain_metrics.jsonl"}}
    logs = {"metrics.jsonl", *before.get(stage, ())}
    assert files == {"manifest.json", *logs, *previews, *MODELS[stage]}
    manifest = read_manifest(folder)
    numbers = manifest["numbers"]
    assert numbers["finished"] and numbers["iterations_done"] == 3 and numbers["processes"] == 1
    assert (numbers["training_frames"], numbers["training_cameras"]) == (4, 4)
    assert numbers["bytes"] == {name: (folder / name).stat().st_size for name in MODELS[stage]}
    assert numbers["gaussians"] == 300 and numbers["parameters"]["total"] > 300 * 20
    assert numbers["peak_memory"]["host"] > 50e6
    assert (numbers["seconds_of_tracking"] > 0) == (stage == "80_teacher")
    assert (numbers["seconds_of_pretraining"] > 0) == (stage in before)
    for kind in ("novel_view", "novel_pose"):
        assert 3 < numbers[kind]["psnr"] < 60 and 3 < numbers["start"][kind]["psnr"] < 60
    assert {c["name"] for c in manifest["checks"]} >= {
        "novel views: PSNR of the person",
        "novel poses: SSIM",
        "iterations done",
    }
    real, rendered, _ = read_strip(folder / "previews" / "Held0_000004.png")
    assert real.shape == rendered.shape == (64, 48, 3) and real.max() > 100
    assert not list(trained.glob("*_work"))


def test_inputs_are_the_files_of_earlier_stages(trained):
    inputs = {stage: set(read_manifest(trained / stage)["inputs"]) for stage in STAGES}
    assert "70_fit/gaussians.safetensors" in inputs["80_teacher"]
    assert "80_teacher/teacher.safetensors" in inputs["85_bake"]
    assert "85_bake/student.safetensors" in inputs["90_compensate"]
    assert all({"60_assemble/smplxpp.npz", "capture/parameters", "capture/cameras"} <= i for i in inputs.values())
    code = {stage: set(read_manifest(trained / stage)["code"]) for stage in STAGES}
    assert all("avatar.training.engine.loop" in modules for modules in code.values())
    assert "avatar.training.student.compensate" not in code["80_teacher"] | code["85_bake"]
    assert not any(name.startswith("avatar.training.student") for name in code["80_teacher"])


def test_the_models_load_and_the_students_blend_shapes_fit_the_template(trained):
    rig = Rig(template())
    teacher = load_avatar(trained / "80_teacher" / "teacher.safetensors", rig)
    student = load_avatar(trained / "90_compensate" / "student_compact.safetensors", rig)
    assert len(teacher.gaussians) == len(student.gaussians) == 300
    assert student.config.blend_shapes.expression_size == rig.expression_size == 2
    assert student.frames == (0, 1, 2, 3)


def test_a_template_without_loose_clothes_simulates_nothing_and_has_nothing_to_say(trained):
    numbers = read_manifest(trained / "83_cloth")["numbers"]
    assert numbers["loose"] == numbers["notes"] == []
    assert load_garments(trained / "83_cloth" / "garments.npz", template()) == []


@pytest.mark.long
def test_a_run_that_does_not_know_its_scans_pose_simulates_nothing_and_says_so_first(tmp_path, caplog):
    run, capture = tmp_path / "run", write_skirted(tmp_path / "skirted")
    (run / TEMPLATE).parent.mkdir(parents=True)
    person().save(run / TEMPLATE)
    with caplog.at_level("INFO"):
        assert train(run, capture, "--until", "cloth") == 0
    words = [(record.levelname, record.message) for record in caplog.records]
    (said,) = read_manifest(run / "83_cloth")["numbers"]["notes"]
    assert "which pose" in said and words.count(("WARNING", f"loose clothes: {said}")) == 1
    assert words.index(("WARNING", f"loose clothes: {said}")) < min(
        k for k, (_, word) in enumerate(words) if word.startswith("70_fit")
    )
    assert load_garments(run / "83_cloth" / "garments.npz", person()) == []


@pytest.mark.long
def test_training_without_simulation_has_no_such_stage(fitted, capture, capsys):
    assert train(fitted, capture, "--cloth", "none", "--until", "teacher") == 0
    assert list(json.loads(capsys.readouterr().out)["stages"]) == ["fit", "teacher"]
    assert not (fitted / "83_cloth").exists()


def test_what_stands_is_not_trained_again(own, capture, capsys):
    made = {stage: (own / stage / "manifest.json").stat().st_mtime_ns for stage in STAGES}
    assert train(own, capture) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["finished"] and not any(stage["ran"] for stage in answer["stages"].values())
    assert list(answer["stages"]) == ["fit", "teacher", "cloth", "bake", "compensate"]
    assert made == {stage: (own / stage / "manifest.json").stat().st_mtime_ns for stage in STAGES}


def test_other_options_train_what_they_concern(own, capture, capsys):
    assert train(own, capture, "--compensate-iterations", "2", "--blend-shapes", "local", "--perceptual", "none") == 0
    stages = json.loads(capsys.readouterr().out)["stages"]
    assert [name for name, numbers in stages.items() if numbers["ran"]] == ["compensate"]
    shapes = load_avatar(own / "90_compensate" / "student.safetensors", Rig(template())).config.blend_shapes
    assert (shapes.parts, shapes.shapes) == (256, 16)


def test_pruned_blend_shapes_fit_the_compact_file_into_its_size(own, capture, capsys):
    limit = 0.1
    assert train(own, capture, "--blend-shapes", "pruned", "--max-megabytes", str(limit)) == 0
    numbers = json.loads(capsys.readouterr().out)["stages"]["compensate"]
    assert numbers["bytes"]["student_compact.safetensors"] <= 1e6 * limit
    assert 0 < numbers["compact"]["kept_blend_shapes"] < 1 and "novel_pose" in numbers["compact"]
    whole = load_avatar(own / "90_compensate" / "student.safetensors", Rig(template()))
    assert len(whole.blend_shapes.active) == 300


@pytest.mark.long
def test_a_limit_of_time_gives_a_model_and_the_same_command_goes_on(trained, fitted, capture, capsys):
    assert train(fitted, capture, "--stage", "teacher", "--max-minutes", "1e-9") == 0
    first = json.loads(capsys.readouterr().out)
    assert not first["finished"] and first["stages"]["teacher"]["iterations_done"] == 1  # of the tracking
    assert first["stages"]["teacher"]["measured_at"] is None
    load_avatar(fitted / "80_teacher" / "teacher.safetensors", Rig(template()))
    assert (fitted / "80_teacher_work").is_dir()
    assert train(fitted, capture, "--stage", "bake") == 2  # of a teacher that is not finished
    assert "1 of 8 iterations" in json.loads(capsys.readouterr().out)["error"]["message"]
    assert train(fitted, capture) == 0
    assert same_models(fitted, trained) and not list(fitted.glob("*_work"))


@pytest.mark.long
def test_seams_of_a_motion_that_is_followed_in_segments_are_figures_with_a_check(fitted, capture, monkeypatch):
    teacher = replace(QUICK.teacher, track=replace(QUICK.teacher.track, segment_frames=2))
    monkeypatch.setattr(training_runs, "QUICK", replace(QUICK, teacher=teacher))
    assert train(fitted, capture, "--until", "teacher") == 0
    manifest = read_manifest(fitted / "80_teacher")
    (seam,) = manifest["numbers"]["seams"]
    assert seam["frame"] == 2 and seam["p95_mm"] >= seam["mean_mm"] >= 0.0
    (check,) = [one for one in manifest["checks"] if "segments" in one["name"]]
    assert check["value"] == (0.0 if seam["in_sequence"] else seam["p95_mm"])
    assert manifest["numbers"]["seconds_of_tracking"] > 0.0 and (fitted / "80_teacher" / "track_seams.json").is_file()


@pytest.mark.long
def test_a_killed_training_goes_on(trained, fitted, capture, monkeypatch):
    step = BakeTask.step

    def killed(self, iteration):
        if iteration == 2:
            raise KeyboardInterrupt
        return step(self, iteration)

    often(monkeypatch)
    monkeypatch.setattr(BakeTask, "step", killed)
    assert train(fitted, capture) == 130
    assert (fitted / "80_teacher").is_dir() and not (fitted / "85_bake").exists()
    monkeypatch.setattr(BakeTask, "step", step)
    assert train(fitted, capture) == 0
    assert same_models(fitted, trained)


@pytest.mark.long
def test_checkpoints_of_other_options_are_not_overwritten(fitted, capture, capsys):
    assert train(fitted, capture, "--stage", "teacher", "--max-minutes", "1e-9") == 0
    capsys.readouterr()
    state_file = fitted / "80_teacher_work" / "track" / "state.safetensors"
    state = state_file.read_bytes()
    other = ("--stage", "teacher", "--teacher-iterations", "2")
    assert train(fitted, capture, *other) == 2
    message = json.loads(capsys.readouterr().out)["error"]["message"]
    assert "--force" in message and "config training.iterations was 3, is 2" in message
    assert state_file.read_bytes() == state
    assert train(fitted, capture, *other, "--force") == 0


def test_a_later_stage_is_not_trained_on_one_that_was_made_otherwise(fitted, capture, capsys):
    assert train(fitted, capture, "--stage", "teacher", "--seed", "5") == 2
    message = json.loads(capsys.readouterr().out)["error"]["message"]
    assert "a finished 70_fit" in message and "seed was 0, is 5" in message


@pytest.mark.long
def test_a_reference_fit_of_the_users_own_is_taken(tmp_path, capture, caplog):
    run = write_dance_run(tmp_path / "run")
    options = ("--gaussians", "123", "--iterations", "1", "--json", "--no-report")
    assert main(["fit", str(run), "--capture", str(capture), *options]) == 0
    made = (run / "70_fit" / "manifest.json").read_bytes()
    with caplog.at_level("INFO"):
        assert train(run, capture, "--until", "teacher", "--force") == 0
    assert (run / "70_fit" / "manifest.json").read_bytes() == made and "taken as it stands" in caplog.text
    assert read_manifest(run / "80_teacher")["numbers"]["gaussians"] == 123


def test_a_reference_fit_that_saw_what_is_held_out_is_refused(tmp_path, capture, capsys):
    run = write_dance_run(tmp_path / "run")
    options = ("--gaussians", "123", "--iterations", "1", "--hold-out", "Ring3", "--json", "--no-report")
    assert main(["fit", str(run), "--capture", str(capture), *options]) == 0
    capsys.readouterr()
    assert train(run, capture, "--until", "teacher") == 2
    message = json.loads(capsys.readouterr().out)["error"]["message"]
    assert all(camera in message for camera in HELD_OUT) and "70_fit" in message and "--hold-out Ring3" in message
    assert not (run / "80_teacher").exists()


def test_a_students_bake_without_a_teacher(fitted, capture, capsys):
    assert train(fitted, capture, "--no-teacher", "--until", "bake") == 0
    assert list(json.loads(capsys.readouterr().out)["stages"]) == ["fit", "bake"]
    assert not (fitted / "80_teacher").exists()
    assert "70_fit/gaussians.safetensors" in read_manifest(fitted / "85_bake")["inputs"]


@pytest.mark.long
def test_held_out_cameras_and_scale_are_the_users_choice(fitted, capture):
    options = ("--until", "teacher", "--hold-out", "Ring1", "--scale", "0.5", "--teacher-iterations", "1")
    assert train(fitted, capture, *options) == 0
    assert read_strip(fitted / "80_teacher" / "previews" / "Ring1_000001.png")[0].shape == (32, 24, 3)
    assert read_manifest(fitted / "80_teacher")["numbers"]["training_cameras"] == 3 + len(HELD_OUT)


def test_the_terminal_shows_figures(own, capture, capsys, monkeypatch):
    monkeypatch.setitem(TRAINING_PRESETS, "demo", QUICK)
    options = [option for option in SMALL if option != "--json"]
    assert main(["train", str(own), "--capture", str(capture), *options]) == 0
    out = capsys.readouterr().out
    assert all(stage in out for stage in ("70_fit", *STAGES)) and "stands" in out and "3 of 3" in out


@pytest.mark.slow
def test_two_processes_that_the_command_starts_train_what_those_of_torchrun_do(fitted, capture, tmp_path):
    other, answers = shutil.copytree(fitted, tmp_path / "other"), []
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    for run, launcher, own in ((fitted, torchrun, ()), (other, (), ("--processes", "2"))):
        command = ["-m", "pipelines.cli", "train", str(run), "--capture", str(capture), *SMALL, *own]
        done = subprocess.run(
            [sys.executable, *launcher, *command], env=environment, capture_output=True, text=True, timeout=900
        )
        assert done.returncode == 0, done.stderr[-3000:]
        answers.append(json.loads(done.stdout))  # the first process alone speaks
        assert answers[-1]["finished"]
        for stage in STAGES:
            manifest = read_manifest(run / stage)
            assert manifest["numbers"]["processes"] == 2 and manifest["config"]["training"]["poses_per_step"] >= 2
    assert same_models(fitted, other)


@pytest.mark.long
def test_an_error_of_the_inputs_is_told_once_by_all_processes(capture, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    (tmp_path / "run").mkdir()
    command = ["-m", "pipelines.cli", "train", str(tmp_path / "run"), "--capture", str(capture), "--processes", "2"]
    done = subprocess.run([sys.executable, *command], env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 2 and done.stderr.count("error:") == 1, done.stderr


def test_processes_get_the_options_of_the_command(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(process, "run_together", lambda *args, **options: asked.append((args, options)) or (0, "{}"))
    command = Train(tmp_path / "run", tmp_path, preset="demo", hold_out=("A", "B"), no_report=True, processes=3)
    assert command._together(gpus=4) is None
    ((words, count), options) = asked[0]
    after = words[words.index("train") + 1 :]
    assert count == 3 and not options["captured"] and after[:3] == [str(tmp_path / "run"), "--processes", "1"]
    assert after[3:] == ["--capture", str(tmp_path), "--preset", "demo", "--hold-out", "A", "B", "--no-report"]
    assert Train(tmp_path / "run", tmp_path, processes=0)._together(gpus=4) is None and asked[1][0][1] == 4
    for wrong in (5, -1):
        with pytest.raises(InputError, match="option processes: expected at most 4, the number of GPUs"):
            Train(tmp_path / "run", tmp_path, processes=wrong)._together(gpus=4)


def test_the_option_for_tensorboard_reaches_the_training(fitted, capture, monkeypatch):
    asked = []

    def stop(run, inputs, scene, config, options, together, *, steps):
        asked.append(options.tensorboard)
        raise InputError("training", expected="none", received="one")

    monkeypatch.setattr(train_stage, "train", stop)
    for options in ((), ("--tensorboard",)):
        assert train(fitted, capture, *options) == 2
    assert asked == [False, True]
