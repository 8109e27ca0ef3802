"""`avatar.train` trains the student of `smplxpp train`, bit for bit; steps are resumed; a student is opened again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import avatar
from avatar.training.train import UnfinishedTrainingError
from pipelines.runs import layout
from smplxpp.capture import open_capture
from smplxpp.capture.sources import FrameParams
from smplxpp.core.errors import InputError
from smplxpp.template.template import Template
from tests.pipelines.training_runs import QUICK, quick

COUNTS = {"fit": 2, "teacher": 3, "bake": 3, "compensate": 3}
CONFIG = avatar.TrainConfig(gaussians=300, iterations=COUNTS, device="cpu")


@pytest.fixture(scope="module")
def capture(danced) -> Path:
    return danced[0]


@pytest.fixture(scope="module")
def run(danced) -> Path:
    """The folder of the command."""
    return danced[1]


def train_in_python(run: Path, capture: Path, out: Path, **config):
    template = Template.load(run / layout.TEMPLATE)
    frame = CONFIG.template_frame if (run / layout.BUILD_FILE).is_file() else None
    options = replace(CONFIG, **{"template_frame": frame, **config})
    with quick():
        return avatar.train(template, open_capture(capture), out, preset=QUICK, config=options)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, run, capture) -> Path:
    """The folder of the Python door."""
    out = tmp_path_factory.mktemp("out") / "dance"
    train_in_python(run, capture, out)
    return out


def same_bits(one: Path, two: Path) -> bool:
    return one.read_bytes() == two.read_bytes()


def test_both_doors_give_the_same_bits(run, folder):
    assert same_bits(run / layout.GAUSSIANS, folder / "fit" / "gaussians.safetensors")
    assert same_bits(run / layout.TEACHER, folder / "teacher" / "teacher.safetensors")
    assert same_bits(run / layout.BAKED, folder / "bake" / "student.safetensors")
    for file in (layout.STUDENT, layout.COMPACT_STUDENT):
        assert same_bits(run / file, folder / "compensate" / Path(file).name)


def test_a_finished_training_is_opened_and_not_repeated(run, capture, folder):
    made = {path: path.stat().st_mtime_ns for path in folder.glob("*/*.safetensors")}
    student = train_in_python(run, capture, folder)
    assert made == {path: path.stat().st_mtime_ns for path in folder.glob("*/*.safetensors")}
    again = avatar.load(folder)
    for one, two in zip(student.state_dict().values(), again.state_dict().values(), strict=True):
        assert torch.equal(one, two)
    assert not list(folder.glob("*_work"))


@pytest.mark.long
def test_what_the_limit_of_time_ended_continues(run, capture, folder, tmp_path):
    for _ in range(40):  # each call takes a step at least
        try:
            student = train_in_python(run, capture, tmp_path, max_minutes=1e-9)
            break
        except UnfinishedTrainingError as error:
            assert "the same call continues" in str(error)
    for name in ("fit/gaussians", "teacher/teacher", "bake/student", "compensate/student"):
        assert same_bits(folder / f"{name}.safetensors", tmp_path / f"{name}.safetensors")
    assert student.frames == avatar.load(folder).frames


@pytest.mark.long
def test_another_seed_trains_again(run, capture, folder, tmp_path):
    train_in_python(run, capture, tmp_path, seed=3)
    assert not same_bits(folder / "bake/student.safetensors", tmp_path / "bake/student.safetensors")


def test_a_student_of_a_run_is_opened_drawn_and_exported(run, capture, tmp_path):
    student, shown = avatar.load(run), open_capture(capture)
    camera = next(iter(shown.cameras.values()))
    params = shown.params(shown.splits.train_frames[0])
    image = avatar.render(student, params, camera)
    assert image.shape == (camera.height, camera.width, 3) and image.dtype == np.uint8 and image.max() > 30
    white = avatar.render(student, params, camera, background=(1.0, 1.0, 1.0))
    assert (white[0, 0] == 255).all() and (image[0, 0] == 0).all()
    report = student.export(tmp_path / "me.avatar", name="dancer", exact=True)
    assert report["bytes"]["total"] == (tmp_path / "me.avatar").stat().st_size
    player = avatar.load(tmp_path / "me.avatar")
    assert player.bundle.about.name == "dancer"
    drawn = avatar.render(player, params, camera)
    assert np.abs(drawn.astype(int) - image.astype(int)).mean() < 0.5  # the native kernels against torch
    for suffix in (".ply", ".spz"):
        assert student.export(tmp_path / f"me{suffix}", params=params)["bytes"] > 1000
    with pytest.raises(InputError, match=r"\.avatar"):
        student.export(tmp_path / "me.txt")
    # Without parameters a bundle plays the poses of the training at their rate.
    student.fps = 12.5
    student.export(tmp_path / "slow.avatar")
    motion = avatar.load(tmp_path / "slow.avatar").motion
    assert motion.fps == 12.5 and len(motion) == len(student.frames)
    alone = avatar.load(run / layout.STUDENT)
    assert torch.equal(alone.gaussians().dc, student.gaussians().dc)


def test_a_file_without_a_template_is_refused(run, tmp_path):
    (tmp_path / "here").mkdir()
    lost = tmp_path / "here" / "student.safetensors"
    lost.write_bytes((run / layout.STUDENT).read_bytes())
    with pytest.raises(InputError, match="template beside it"):
        avatar.load(lost)
    assert avatar.load(lost, template=Template.load(run / layout.TEMPLATE)).frames
    with pytest.raises(InputError, match="trained student"):
        (tmp_path / "empty" / "60_assemble").mkdir(parents=True)
        (tmp_path / "empty" / layout.TEMPLATE).write_bytes((run / layout.TEMPLATE).read_bytes())
        avatar.load(tmp_path / "empty")


def test_the_library_opens_the_files_that_a_run_has():
    from avatar.models.open_student import RUN_FILES

    names = (layout.TEMPLATE, layout.STUDENT, layout.GARMENTS, layout.PARAMS)
    assert (RUN_FILES.template, RUN_FILES.student, RUN_FILES.garments, RUN_FILES.reference) == names


def test_options_are_refused_before_work(run, capture, tmp_path):
    for config in ({"seed": -1}, {"iterations_share": 0.0}, {"max_minutes": 0.0}, {"iterations": {"nap": 2}}):
        with pytest.raises(InputError):
            replace(CONFIG, **config)
    template, opened = Template.load(run / layout.TEMPLATE), open_capture(capture)
    for options in ({"refine": "perhaps"}, {"cloth": "field"}, {"preset": "huge"}):
        with pytest.raises(InputError):
            avatar.train(template, opened, tmp_path / "none", **options)
    with pytest.raises(InputError, match="poses that are refined too"):
        avatar.train(template, opened, tmp_path / "none", config=avatar.TrainConfig(refine_cameras=True))


def test_registered_parameters_in_memory_count_as_estimates(capture):
    from smplxpp.capture.declared import has_estimated_params

    opened = open_capture(capture)
    rows = {frame: opened.params(frame) for frame in opened.frames if opened.params(frame) is not None}
    for estimated in (True, False):
        recording = replace(opened.recording, params=FrameParams(rows, estimated=estimated))
        assert has_estimated_params(replace(opened, recording=recording)) == estimated
    assert json.loads((capture / "capture.json").read_text()) is not None
