"""`smplxpp evaluate --cloth`: a student's skirt simulated, moved by its field, or by the joints alone."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

from avatar import EvaluationConfig
from avatar.data.cloth_motion import ClothMotions
from avatar.data.sequence import AvatarSequence
from avatar.evaluation.evaluate import evaluate_models
from avatar.evaluation.protocol import AsNew
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.model_file import save_avatar
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked_surface import ControlCage, Track
from avatar.rig.rig import Rig
from pipelines.runs.layout import GARMENTS, MODEL_FILES, REFINED_HELD_OUT_PARAMS, TEACHER
from pipelines.runs.stage import SCHEMA, read_manifest
from pipelines.stages.evaluate_inputs import load_model
from pipelines.stages.scene import TrainInputs, open_scene
from smplxpp.body import load_params
from smplxpp.capture import open_capture
from smplxpp.cloth.calibrate import with_values
from smplxpp.cloth.garment_file import load_garments, save_garments
from smplxpp.core.params import BodyParams
from tests.cloth.persons import PART, person
from tests.dolls.skirted import NOVEL_POSES, garment, moved, write_skirted
from tests.dolls.tiny import TINY_TEACHER
from tests.pipelines.test_evaluate import draw_no_surfaces, evaluate, refused, write_models

FEW = ("--sets", "novel_pose", "--every", "1", "--no-report", "--shown", "0", "--models", "student")


@pytest.fixture(autouse=True)
def figures_alone(monkeypatch):
    draw_no_surfaces(monkeypatch)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_skirted(tmp_path_factory.mktemp("captures") / "skirted")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    run = tmp_path_factory.mktemp("runs") / "skirted"
    (run / "60_assemble").mkdir(parents=True)
    person().save(run / "60_assemble" / "smplxpp.npz")
    write_models(run, person())
    (run / GARMENTS).parent.mkdir()
    save_garments(run / GARMENTS, [garment()])
    return run


def measured(run, capture, capsys, *options: str) -> dict:
    """The student's distance to the true skirt in held-out frames, millimetres, and whether it was measured now."""
    assert evaluate(run, capture, *FEW, *options) == 0
    answer = json.loads(capsys.readouterr().out)
    mean = answer["models"]["student"]["surfaces"]["held_out"]["mean"]
    return {"ran": answer["ran"], "p2s": mean["labels"][PART]["p2s"]}


@pytest.mark.long
def test_a_simulated_skirt_is_nearer_to_the_true_one_than_a_skinned_one(trained, capture, tmp_path, capsys):
    run = shutil.copytree(trained, tmp_path / "run")
    simulated = measured(run, capture, capsys)
    assert read_manifest(run / "95_evaluate")["config"]["cloth"] == "simulate"
    assert measured(run, capture, capsys)["ran"] is False  # it stands
    skinned = measured(run, capture, capsys, "--cloth", "skin")
    moved_by_field = measured(run, capture, capsys, "--cloth", "field")
    assert skinned["ran"] and moved_by_field["ran"]
    assert simulated["p2s"] < 0.6 * skinned["p2s"]
    assert moved_by_field["p2s"] not in (simulated["p2s"], skinned["p2s"])


@pytest.mark.long
def test_poses_that_were_refined_have_their_skirt_simulated_too(trained, capture, tmp_path, capsys):
    """Held-out poses "refined" to what they are give the same pictures and surfaces."""
    run = shutil.copytree(trained, tmp_path / "run")
    (run / REFINED_HELD_OUT_PARAMS).parent.mkdir()
    BodyParams.concatenate([load_params(path) for path in sorted((capture / "params").glob("*.npz"))]).save(
        run / REFINED_HELD_OUT_PARAMS
    )
    assert evaluate(run, capture, *FEW) == 0
    answer = json.loads(capsys.readouterr().out)
    own, refined = answer["models"]["student"], answer["refined_poses"]["student"]
    assert refined["views"] == own["views"] and refined["surfaces"]["held_out"] == own["surfaces"]["held_out"]


def with_a_teacher(run, capture, digests) -> None:
    """A teacher that followed the true skirt through the training frames, as its stage leaves it."""
    torch.manual_seed(0)
    rig = Rig(person())
    teacher = TeacherAvatar(TINY_TEACHER, rig, sample_on_mesh(person(), SamplingConfig(count=200)))
    cage = ControlCage(rig, person().vertex_count)
    controls = torch.tensor(moved()[: NOVEL_POSES[0]]).float()[:, cage.vertices]
    teacher.remember(Track({frame: frame for frame in range(len(controls))}, controls, cage))
    (run / TEACHER).parent.mkdir()
    save_avatar(run / TEACHER, teacher)
    seen = {"cameras": ["Ring0"], "frames": list(range(NOVEL_POSES[0]))}
    record = {"schema": SCHEMA, "key": "", "inputs": digests, "files": {}, "numbers": {"seen": seen}, "checks": []}
    (run / TEACHER).with_name("manifest.json").write_text(json.dumps(record))


@pytest.mark.long
def test_clothes_go_on_from_where_the_teacher_followed_them_beside_a_cold_start(trained, capture, tmp_path, capsys):
    run = shutil.copytree(trained, tmp_path / "run")
    # A drag far above the truth's: what was seen of the swing tells it, a cold start does not. With a drag near the
    # truth's both are alike up to chaos, which the last bits of another kind of CPU decide.
    save_garments(run / GARMENTS, [with_values(garment(), drag=8.0, pin_depth=0.014)])
    digests = open_scene(run, TrainInputs(capture, None, None, (), 1.0, None)).digests
    with_a_teacher(run, capture, digests)
    assert evaluate(run, capture, *FEW) == 0
    answer = json.loads(capsys.readouterr().out)
    cold, followed = (answer[key]["student"]["surfaces"]["held_out"]["mean"] for key in ("models", "followed_clothes"))
    assert followed["labels"][PART]["p2s"] < 0.8 * cold["labels"][PART]["p2s"]
    assert answer["followed_clothes"].keys() == {"student"}
    assert (run / "95_evaluate" / "tables" / "novel_pose_followed.csv").is_file()
    # Of a person who stands in other poses in these frames the teacher has seen nothing.
    with_a_teacher(shutil.rmtree(run / "80_teacher") or run, capture, {**digests, "capture/parameters": "others"})
    assert evaluate(run, capture, *FEW) == 0
    assert json.loads(capsys.readouterr().out)["followed_clothes"] == {}


@pytest.mark.long
def test_other_garments_are_measured_anew_and_none_are_the_field(trained, capture, tmp_path, capsys):
    run = shutil.copytree(trained, tmp_path / "run")
    by_field = measured(run, capture, capsys, "--cloth", "field")["p2s"]
    save_garments(run / GARMENTS, [])
    assert measured(run, capture, capsys) == {"ran": False, "p2s": by_field}
    assert read_manifest(run / "95_evaluate")["config"]["cloth"] == "field"


@pytest.mark.long
def test_a_capture_without_its_frame_rate_is_refused_and_says_what_to_do(trained, capture, tmp_path, capsys):
    run, silent = shutil.copytree(trained, tmp_path / "run"), shutil.copytree(capture, tmp_path / "capture")
    about = json.loads((silent / "capture.json").read_text())
    (silent / "capture.json").write_text(json.dumps({name: value for name, value in about.items() if name != "fps"}))
    assert "--cloth field" in refused(capsys, run, silent, *FEW)
    for cloth in ("field", "skin"):  # neither asks how long a frame lasts
        assert evaluate(run, silent, *FEW, "--cloth", cloth) == 0


def test_a_damaged_file_of_garments_is_refused(trained, capture, tmp_path, capsys):
    run = shutil.copytree(trained, tmp_path / "run")
    (run / GARMENTS).write_bytes(b"not a file of garments")
    assert "Train again" in refused(capsys, run, capture, *FEW)


@pytest.mark.long
def test_a_student_shown_as_new_is_itself_in_new_poses_and_simulated_in_those_of_the_training(trained, capture):
    opened = open_capture(capture)
    motions = ClothMotions(
        person(),
        load_garments(trained / GARMENTS, person()),
        params=opened.params,
        frames=opened.frames,
        fps=opened.fps,
    )
    sequence = AvatarSequence(opened, person(), cloth=motions)
    student = load_model("student", trained / MODEL_FILES["student"], sequence.rig)
    config = EvaluationConfig(metric="none", samples=4000, speed_pictures=0, shown=0)
    report = evaluate_models({"own": student, "as new": AsNew(student)}, sequence, config).report
    own, new = report.models["own"], report.models["as new"]
    assert new.views["novel_pose"] == own.views["novel_pose"] and new.surfaces["held_out"] == own.surfaces["held_out"]
    plain = AvatarSequence(opened, person())
    still = evaluate_models({"as new": AsNew(student)}, plain, config).report.models["as new"]
    assert new.views["novel_view"] not in (own.views["novel_view"], still.views["novel_view"])
