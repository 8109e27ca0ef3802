"""`smplxpp fit` from end to end on a doll: files, figures, skipping, resuming, and what it refuses."""

from __future__ import annotations

import json
import shutil
import sys

import numpy as np
import pytest
import torch
from PIL import Image

from avatar.formats.ply import read_splat_ply
from avatar.gaussians.tensor_file import load_bound
from avatar.training.engine.resources import choose_device
from pipelines.cli import main
from pipelines.commands import inspect, options
from pipelines.commands.inspect import summarise_run
from pipelines.commands.terminal import training_progress
from pipelines.runs.stage import SCHEMA, read_manifest
from smplxpp.core.params import BodyParams
from smplxpp.figures.drawings import read_strip
from tests.dolls.standing import HELD_OUT, TRAIN, doll, write_capture, write_run

SMALL = ("--gaussians", "1500", "--iterations", "12", "--device", "cpu", "--json")


def fit(run, capture, *options: str) -> int:
    return main(["fit", str(run), "--capture", str(capture), *SMALL, *options])


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("captures") / "doll")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory, capture):
    run = write_run(tmp_path_factory.mktemp("runs") / "doll")
    assert fit(run, capture) == 0
    return run


@pytest.fixture
def own(fitted, tmp_path):
    """A copy of the fitted run to change."""
    return shutil.copytree(fitted, tmp_path / "run")


def refused(capsys, run, capture, *options: str) -> str:
    """The message of a fit that must be refused before anything is written."""
    before = sorted(run.rglob("*")) if run.exists() else []
    assert fit(run, capture, *options) == 2
    message = json.loads(capsys.readouterr().out)["error"]["message"]
    assert (sorted(run.rglob("*")) if run.exists() else []) == before
    return message


def same_fit(one, two) -> bool:
    """Whether two runs hold the same Gaussians, bit for bit."""
    a, b = (load_bound(run / "70_fit" / "gaussians.safetensors").tensors for run in (one, two))
    splats = [(run / "70_fit" / "splats.ply").read_bytes() for run in (one, two)]
    return splats[0] == splats[1] and all(value.equal(b[name]) for name, value in a.items())


def test_files_and_figures(fitted):
    folder = fitted / "70_fit"
    files = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    strips = {f"previews/{name}.png" for name in (*HELD_OUT, "Ring0", "Ring3", "Face")}
    assert files == {"manifest.json", "gaussians.safetensors", "splats.ply", "metrics.jsonl", *strips}
    gaussians = load_bound(folder / "gaussians.safetensors", faces=doll().template.faces)
    assert len(gaussians) == len(read_splat_ply(folder / "splats.ply")) == 1500
    numbers = read_manifest(folder)["numbers"]
    assert numbers["finished"] and numbers["iterations_done"] == 12
    assert set(numbers["held_out"]) == set(HELD_OUT) and set(numbers["train"]) == set(TRAIN)
    assert 10 < numbers["mean"]["held_out"]["psnr"] < 60
    assert "0.02" in numbers["convention"]
    real, rendered, error = read_strip(folder / "previews" / "Held0.png")
    np.testing.assert_array_equal(real, doll().images["Held0"])
    assert rendered.shape == error.shape == real.shape
    assert not list(fitted.glob("70_fit_work"))


def test_inspect_knows_the_stage_and_tells_when_its_template_changed(own):
    summary, checks = summarise_run(own)
    stage = next(s for s in summary["stages"] if s["stage"] == "70_fit")
    assert stage["state"] == "done" and stage["files"] == 8
    assert {c.name for c in checks if c.stage == "70_fit"} >= {
        "novel views: PSNR of the person",
        "novel views: gain of PSNR since the start",
    }
    (own / "60_assemble" / "manifest.json").write_text(
        json.dumps({"schema": SCHEMA, "stage": "60_assemble", "seconds": 1.0, "files": {"smplxpp.npz": "other"}})
    )
    summary, _ = summarise_run(own)
    assert next(s for s in summary["stages"] if s["stage"] == "70_fit")["state"] == "outdated"


@pytest.mark.parametrize(
    ("stage", "command"),
    [("70_fit", "fit"), ("50_unpose", "build"), ("85_bake", "train"), ("95_evaluate", "evaluate")],
)
def test_inspect_says_which_command_makes_a_stage(own, stage, command):
    assert f"smplxpp {command} " in inspect._remedy(own, stage)


def test_a_fit_that_stands_is_not_run_again(own, capture, capsys):
    made = (own / "70_fit" / "manifest.json").stat().st_mtime_ns
    assert fit(own, capture) == 0
    assert json.loads(capsys.readouterr().out)["ran"] is False
    assert (own / "70_fit" / "manifest.json").stat().st_mtime_ns == made
    assert fit(own, capture, "--seed", "1") == 0
    assert json.loads(capsys.readouterr().out)["ran"] is True


def test_a_limit_of_time_gives_a_result_and_the_same_command_goes_on(fitted, tmp_path, capture, capsys):
    run = write_run(tmp_path / "run")
    assert fit(run, capture, "--max-minutes", "1e-9") == 0
    first = json.loads(capsys.readouterr().out)
    assert (first["iterations_done"], first["finished"]) == (1, False)
    assert (run / "70_fit" / "splats.ply").is_file() and (run / "70_fit_work").is_dir()
    assert {c["name"]: c["status"] for c in first["checks"]}["iterations done"] == "warn"
    assert fit(run, capture) == 0
    assert json.loads(capsys.readouterr().out)["finished"]
    assert same_fit(run, fitted)
    assert not (run / "70_fit_work").exists()


def test_a_killed_fit_goes_on(fitted, tmp_path, capture, monkeypatch):
    from avatar.training.engine import loop
    from avatar.training.fit.fit import FitTask

    run = write_run(tmp_path / "run")
    step = FitTask.step

    def killed(self, iteration):
        if iteration == 7:
            raise KeyboardInterrupt
        return step(self, iteration)

    monkeypatch.setattr(loop.LoopConfig, "__init__", _often(loop.LoopConfig.__init__))
    monkeypatch.setattr(FitTask, "step", killed)
    assert fit(run, capture) == 130
    assert not (run / "70_fit").exists()
    monkeypatch.setattr(FitTask, "step", step)
    assert fit(run, capture) == 0
    assert same_fit(run, fitted)


def _often(init):
    """`LoopConfig.__init__` with a checkpoint after every step."""

    def often(self, **values):
        init(self, **{**values, "checkpoint_seconds": 0.0})

    return often


def test_progress_shows_a_fit_that_is_taken_up_again():
    from avatar.training.engine.loop import Progress

    with training_progress("fit", 20) as show:
        show(Progress(10, 20, 1.0, 5.0, {"loss": 0.5}))
        show(Progress(20, 20, 2.0, 5.0, {"loss": 0.4}, {"held_out": True, "mean": {"psnr": 20.0}}))


def test_held_out_cameras_are_the_users_choice(tmp_path, capture, capsys):
    run = write_run(tmp_path / "run")
    assert fit(run, capture, "--hold-out", "Ring1", "--iterations", "1", "--scale", "0.5") == 0
    numbers = json.loads(capsys.readouterr().out)
    assert list(numbers["held_out"]) == ["Ring1"] and set(numbers["train"]) == {*TRAIN, *HELD_OUT} - {"Ring1"}
    assert read_strip(run / "70_fit" / "previews" / "Ring1.png")[0].shape == (40, 32, 3)


def test_what_the_capture_lacks_is_said_before_work_starts(tmp_path, capsys):
    run = write_run(tmp_path / "run")
    root = write_capture(tmp_path / "capture")
    assert "frame 3" in refused(capsys, run, root, "--frame", "3")
    assert "Nowhere" in refused(capsys, run, root, "--hold-out", "Nowhere")
    assert "all held out" in refused(capsys, run, root, "--hold-out", *TRAIN, *HELD_OUT)
    assert "scale" in refused(capsys, run, root, "--scale", "0")
    assert "max-minutes" in refused(capsys, run, root, "--max-minutes", "0")
    assert "iterations" in refused(capsys, run, root, "--iterations", "0")
    mask = root / "masks" / "Ring0" / "Ring0_mask000000.png"
    mask.rename(tmp_path / "mask.png")
    assert "mask of camera Ring0" in refused(capsys, run, root)
    (tmp_path / "mask.png").rename(mask)
    image = root / "rgbs" / "Ring2" / "Ring2_rgb000000.png"
    Image.fromarray(np.zeros((10, 10, 3), np.uint8)).save(image)
    assert "Ring2" in refused(capsys, run, root)
    (root / "params" / "000000.npz").unlink()
    assert "parameters of frame 0" in refused(capsys, run, root)
    shutil.rmtree(root / "rgbs")
    assert "cameras and their images" in refused(capsys, run, root)
    assert "existing folder" in refused(capsys, run, tmp_path / "nothing")


def test_a_run_without_a_template_is_refused(tmp_path, capture, capsys):
    run = tmp_path / "run"
    run.mkdir()
    assert "smplxpp build" in refused(capsys, run, capture)


def test_a_template_that_stands_elsewhere_than_the_images_is_refused(tmp_path, capsys):
    run, root = write_run(tmp_path / "run"), write_capture(tmp_path / "capture")
    away = BodyParams.rest(betas=2, expressions=0)
    BodyParams(**{**away.as_dict(), "transl": np.array([[0.6, 0.0, 0.0]])}).save(root / "params" / "000000.npz")
    assert "template in the images" in refused(capsys, run, root)


def test_a_missing_extra_is_named(fitted, capture, capsys, monkeypatch):
    monkeypatch.setattr(options, "find_spec", lambda name: None)
    assert fit(fitted, capture) == 2
    assert "(extra avatar)" in json.loads(capsys.readouterr().out)["error"]["message"]


def test_the_terminal_shows_figures_and_where_things_are(own, capture, capsys):
    options = [o for o in SMALL if o != "--json"]
    assert main(["fit", str(own), "--capture", str(capture), *options]) == 0
    out = capsys.readouterr().out
    assert "mean, held out" in out and "stands, not run again" in out and "splats.ply" in out


def test_cameras_that_the_splits_leave_out_are_not_trained_on(tmp_path, capture, capsys):
    mine = shutil.copytree(capture, tmp_path / "capture")
    about = json.loads((mine / "capture.json").read_text())
    (mine / "capture.json").write_text(json.dumps({**about, "train_views": list(TRAIN[:2])}))
    assert fit(write_run(tmp_path / "run"), mine, "--iterations", "1", "--scale", "0.5") == 0
    numbers = json.loads(capsys.readouterr().out)
    assert set(numbers["train"]) == set(TRAIN[:2]) and set(numbers["held_out"]) == set(HELD_OUT)


def test_the_gpu_is_taken_where_gsplat_is(monkeypatch, caplog):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for found, device in ((None, "cpu"), (object(), "cuda")):
        module = sys.modules["avatar.training.engine.resources"]
        monkeypatch.setattr(module, "find_spec", lambda name, found=found: found)
        assert choose_device("auto") == device and choose_device("cuda") == "cuda"
    assert "gsplat is not installed" in caplog.text
