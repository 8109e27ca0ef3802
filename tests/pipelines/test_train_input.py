"""What `smplxpp train` refuses before it starts, and what it leaves out with a warning."""

from __future__ import annotations

import json
import shutil
import warnings
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from avatar.training import recipe
from pipelines.commands import options
from pipelines.runs.stage import SCHEMA, read_manifest
from pipelines.stages import scene as scene_module
from pipelines.stages.scene import TrainInputs, open_scene, refuse_seen
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.template.template import Template
from tests.dolls.dancing import FRAMES, HEIGHT, HELD_OUT, TRAIN, WIDTH, dance, template, write_dance, write_dance_run
from tests.pipelines.training_runs import refused, train


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return write_dance(tmp_path_factory.mktemp("captures") / "dance")


@pytest.fixture
def capture(original, tmp_path):
    """A copy to spoil."""
    return shutil.copytree(original, tmp_path / "capture")


@pytest.fixture
def run(tmp_path):
    return write_dance_run(tmp_path / "run")


def write_params(capture, frame: int, **changes) -> None:
    replace(dance().frame(frame), **changes).save(capture / "params" / f"{frame:06d}.npz")


def write_template(run, changed: Template) -> None:
    changed.save(run / "60_assemble" / "smplxpp.npz")


def opened(run, capture, **inputs):
    return open_scene(run, TrainInputs(capture, **inputs))


def test_a_good_capture_has_nothing_to_say(run, original):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = opened(run, original)
    assert scene.overlap > 0.9 and scene.frame == 0
    splits = scene.capture.splits
    assert (splits.train_frames, splits.novel_pose_frames) == ((0, 1, 2, 3), (4, 5))
    assert (splits.train_cameras, splits.novel_view_cameras) == (TRAIN, HELD_OUT)


def test_a_run_without_a_template(tmp_path, original, capsys):
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "smplxpp build" in refused(capsys, empty, original)


def test_parameters_of_another_person(run, capture, capsys):
    for frame in range(FRAMES):
        write_params(capture, frame, betas=np.array([[3.0, 0.0]]))
    message = refused(capsys, run, capture)
    assert "60 mm" in message and "person" in message


def test_parameters_of_a_slightly_other_shape_are_doubted(run, capture):
    for frame in range(FRAMES):
        write_params(capture, frame, betas=np.array([[0.5, 0.0]]))
    with pytest.warns(GeometryWarning, match="10 mm off"):
        opened(run, capture)


def test_a_template_that_is_elsewhere_than_the_masks(run, capture, capsys):
    for frame in range(FRAMES):
        write_params(capture, frame, transl=np.array([[0.0, 0.0, 0.6]]))
    assert "template in the images" in refused(capsys, run, capture)


def test_parameters_of_another_moment_are_found_in_later_frames(run, capture, capsys):
    """The first frame is right: looking at it alone would not tell."""
    write_params(capture, 3, transl=np.array([[0.7, 0.0, 0.0]]))
    assert "template in the images" in refused(capsys, run, capture)


def test_frames_without_parameters_are_left_out_and_none_at_all_is_an_error(run, capture, capsys):
    (capture / "params" / "000000.npz").unlink()
    (capture / "params" / "000005.npz").unlink()
    with pytest.warns(GeometryWarning, match="2 of 6 frames are left out"):
        scene = opened(run, capture)
    assert scene.capture.splits.train_frames == (1, 2, 3) and scene.frame == 1
    assert scene.capture.splits.novel_pose_frames == (4,)
    for frame in (1, 2, 3):
        (capture / "params" / f"{frame:06d}.npz").unlink()
    assert "body parameters of the training frames" in refused(capsys, run, capture)


def test_a_frame_with_damaged_parameters_is_left_out_by_name(run, capture):
    (capture / "params" / "000002.npz").write_bytes(b"nothing")
    with pytest.warns(GeometryWarning, match=r"1 of 6 frames.*000002\.npz"):
        assert opened(run, capture).capture.splits.train_frames == (0, 1, 3)


def test_images_of_another_size_than_their_camera(run, capture, capsys):
    Image.new("RGB", (10, 10)).save(capture / "rgbs" / "Ring2" / "Ring2_rgb000000.png")
    assert "Ring2" in refused(capsys, run, capture)


@pytest.mark.filterwarnings("default::smplxpp.core.errors.GeometryWarning")
def test_masks_that_are_zero(run, capture, capsys):
    for path in (capture / "masks").rglob("*.png"):
        Image.new("L", (WIDTH, HEIGHT)).save(path)
    with (
        pytest.warns(GeometryWarning, match="no person in the mask"),
        pytest.raises(InputError, match="a person in them"),
    ):
        opened(run, capture)
    assert train(run, capture) == 2
    assert "capture check" in json.loads(capsys.readouterr().out)["error"]["message"]


def test_views_without_a_mask_are_left_out_and_none_at_all_is_an_error(run, capture, capsys):
    (capture / "masks" / "Ring1" / "Ring1_mask000002.png").unlink()
    with pytest.warns(GeometryWarning, match="1 views are left out: no mask of camera Ring1, frame 2"):
        scene = opened(run, capture)
    assert scene.capture.file("Ring1", 2) is None and scene.capture.file("Ring1", 1) is not None
    shutil.rmtree(capture / "masks")
    assert "no mask" in refused(capsys, run, capture)


def test_a_capture_without_images_of_training_frames(run, capture, capsys):
    for camera in TRAIN:
        shutil.rmtree(capture / "rgbs" / camera)
    assert "no image" in refused(capsys, run, capture)


@pytest.mark.filterwarnings("default::smplxpp.core.errors.GeometryWarning")
@pytest.mark.long
def test_a_template_without_clothes_trains(run, original, capsys):
    write_template(run, replace(template(), vertex_labels=0 * template().vertex_labels))
    with pytest.warns(GeometryWarning, match="no clothes"):
        opened(run, original)
    assert train(run, original) == 0
    assert json.loads(capsys.readouterr().out)["finished"]


def test_a_body_without_expressions_can_be_baked_but_not_compensated(run, original, capsys):
    without = replace(
        template(), body=replace(template().body, exprdirs=template().body.exprdirs[..., :0], expression_names=())
    )
    write_template(run, without)
    assert "expression" in refused(capsys, run, original)
    assert train(run, original, "--until", "fit") == 0


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--hold-out", "Nowhere"), "Nowhere"),
        (("--hold-out", *TRAIN, *HELD_OUT), "all held out"),
        (("--scale", "0"), "scale"),
        (("--max-minutes", "0"), "max-minutes"),
        (("--iterations-share", "0"), "iterations-share"),
        (("--bake-iterations", "0"), "bake-iterations"),
        (("--gaussians", "0"), "gaussians"),
        (("--batch", "0"), "batch"),
        (("--seed", "-1"), "seed"),
        (("--max-megabytes", "nan"), "max-megabytes"),
        (("--no-teacher", "--stage", "teacher"), "no-teacher"),
        (("--no-teacher", "--loose-parts", "dress"), "no-teacher"),
        (("--no-teacher", "--stage", "cloth"), "no-teacher"),
        (("--cloth", "none", "--loose-parts", "dress"), "option cloth"),
        (("--cloth", "none", "--until", "cloth"), "option cloth"),
        (("--loose-parts", "dress", "cape"), "cape"),
        (("--loose-parts", "dress"), "params.npz"),
        (("--stage", "teacher"), "a finished 70_fit"),
        (("--stage", "bake"), "a finished 80_teacher"),
        (("--stage", "compensate"), "a finished 85_bake"),
    ],
)
def test_options_that_make_no_sense(run, original, capsys, options, word):
    assert word in refused(capsys, run, original, *options)


def test_a_missing_extra_is_named(run, original, capsys, monkeypatch):
    monkeypatch.setattr(options, "find_spec", lambda name: None)
    assert "(extra avatar)" in refused(capsys, run, original)


def test_a_perceptual_metric_that_is_not_installed(run, original, capsys, monkeypatch):
    """Asked for by name it is an error before work starts; `auto` warns and goes without."""
    import avatar.losses.perceptual_weights as perceptual

    def missing(*args):
        raise perceptual.MissingPackageError("lpips", command="pip install lpips", purpose="LPIPS")

    monkeypatch.setattr(perceptual, "load_lpips", missing)
    assert "pip install lpips" in refused(capsys, run, original, "--perceptual", "lpips")


def test_auto_takes_the_metric_that_is_there(monkeypatch, caplog):
    from avatar.training.presets import training_preset

    there: set[str] = set()
    monkeypatch.setattr(recipe, "find_spec", lambda name: name if name in there else None)
    paper = training_preset("paper")
    assert recipe.choose_perceptual("auto", training_preset("demo")) == "none" and not caplog.text
    assert recipe.choose_perceptual("auto", paper) == "none" and "pip install" in caplog.text
    there.add("stlpips_pytorch")
    assert recipe.choose_perceptual("auto", paper) == "st-lpips"
    there.add("lpips")
    assert recipe.choose_perceptual("auto", paper) == "lpips"
    assert recipe.choose_perceptual("none", paper) == "none"


def test_a_checkpoint_of_a_newer_version_is_refused_and_kept(run, original, capsys):
    from safetensors.torch import load_file, save_file

    assert train(run, original, "--until", "fit") == 0
    assert train(run, original, "--stage", "teacher", "--max-minutes", "1e-9") == 0
    capsys.readouterr()
    state = run / "80_teacher_work" / "track" / "state.safetensors"
    save_file(load_file(state), state, metadata={"training": json.dumps({"schema": 99})})
    kept = state.read_bytes()
    assert train(run, original, "--stage", "teacher") == 2
    assert "version 99" in json.loads(capsys.readouterr().out)["error"]["message"] and state.read_bytes() == kept


@pytest.mark.parametrize("shortage", [MemoryError(), OSError(28, "No space left on device")])
def test_what_runs_out_is_said_and_finished_stages_stay(run, original, capsys, monkeypatch, shortage):
    from avatar.training.fit_teacher import TeacherTask

    def broken(self, iteration):
        raise shortage

    monkeypatch.setattr(TeacherTask, "step", broken)
    assert train(run, original) == 2
    message = json.loads(capsys.readouterr().out)["error"]["message"]
    assert "memory" in message or "disk" in message
    assert read_manifest(run / "70_fit")["numbers"]["finished"] and not (run / "80_teacher").exists()
    assert (run / "80_teacher_work").is_dir()


def test_a_template_of_a_held_out_frame_is_refused_before_training(run, capture, monkeypatch):
    monkeypatch.setattr(scene_module, "_template_frame", lambda run, inputs: 4)
    with pytest.raises(InputError, match="frame 4, whose scan the template"):
        opened(run, capture)
    monkeypatch.setattr(scene_module, "_template_frame", lambda run, inputs: 1)
    assert opened(run, capture).template_frame == 1


def test_another_lens_is_another_capture(run, capture):
    before = opened(run, capture).digests
    path = capture / "cameras.json"
    content = json.loads(path.read_text())
    cameras = content["cameras"]
    first = cameras[0] if isinstance(cameras, list) else next(iter(cameras.values()))
    first["dist"] = [0.1, 0.0, 0.0, 0.0, 0.0]
    path.write_text(json.dumps(content))
    assert opened(run, capture).digests["capture/cameras"] != before["capture/cameras"]


def test_a_refusal_names_the_stages_that_saw_what_is_held_out_alone(run, original):
    for name, frames in (("70_fit", [0]), ("80_teacher", [0, 4])):
        (run / name).mkdir()
        seen = {"seen": {"cameras": list(TRAIN), "frames": frames}}
        (run / name / "manifest.json").write_text(json.dumps({"schema": SCHEMA, "numbers": seen}))
    with pytest.raises(InputError, match="frames 4, which 80_teacher learned from"):
        refuse_seen(run, ("70_fit", "80_teacher"), opened(run, original).capture.splits)
