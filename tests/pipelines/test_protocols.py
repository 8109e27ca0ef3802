"""A run keeps to its protocol, and nothing of another reaches what it trains."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar.evaluation.input_protocol import InputProtocol
from avatar.evaluation.report import EvalReport
from avatar.training.presets import training_preset
from avatar.training.recipe import STEPS, Recipe, note_missing_normals
from pipelines.cli import main
from pipelines.commands.build import Build
from pipelines.runs.code import sha256_file
from pipelines.runs.stage import SCHEMA
from pipelines.stages.build_config import BuildConfig, BuildInputs, load_build, save_build
from pipelines.stages.evaluate_inputs import covered_vertices, input_protocol
from pipelines.stages.run_inputs import chosen_protocol
from pipelines.stages.scene import TrainInputs, open_frame, open_scene
from smplxpp.capture import open_capture
from smplxpp.core import BodyParams, InputError
from tests.dolls.standing import FRAMES, NOVEL, dressed, write_frames
from tests.pipelines.test_evaluate import QUICK, draw_no_surfaces, write_dressed, write_models

EXACT = {"parameters": "params.npz", "labels": "labels", "scan_labels": True, "normals": "normals", "keypoints": None}
TRACKED = {
    **EXACT,
    "parameters": "params_noisy.npz",
    "labels": "labels_estimated",
    "scan_labels": False,
    "normals": None,
}
AWAY = 0.01
"""Metres that the tracked parameters are off."""


def stand(away: float) -> BodyParams:
    """All frames of the doll, this far aside."""
    rest = BodyParams.rest(betas=2, expressions=0)
    return BodyParams.concatenate([replace(rest, transl=np.array([[away, 0.0, 0.0]]))] * FRAMES)


def write_protocols(root: Path) -> Path:
    """The doll's capture with exact and tracked parameters, labels and normals."""
    write_frames(root)
    for path in (root / "params").iterdir():
        path.unlink()
    stand(0.0).save(root / "params" / "params.npz")
    stand(AWAY).save(root / "params" / "params_noisy.npz")
    for folder in ("labels", "labels_estimated"):
        for camera in ("Ring0", "Ring1", "Held0"):
            (root / folder / camera).mkdir(parents=True)
            (root / folder / camera / f"{camera}_label000000.png").touch()
    (root / "normals").mkdir()
    (root / "scans").mkdir()
    (root / "scans" / "scan_000000.ply").touch()
    (root / "scans" / "scan_000000_labels.npz").touch()
    content = json.loads((root / "capture.json").read_text())
    content["protocols"] = {"exact": EXACT, "tracked": TRACKED}
    (root / "capture.json").write_text(json.dumps(content))
    return root


@pytest.fixture
def root(tmp_path):
    return write_protocols(tmp_path / "capture")


def run_of(folder: Path, root: Path, protocol: str | None, **options) -> Path:
    """A run that holds a template, built by a protocol."""
    run = write_dressed(folder)
    inputs = Build(run_folder=run, capture=root, protocol=protocol, **options).plan().inputs
    save_build(run, inputs, BuildConfig())
    return run


# --- what a build reads ---------------------------------------------------------------------------------------------


def test_a_build_takes_the_files_of_its_protocol(root, tmp_path):
    exact, tracked = (
        Build(run_folder=tmp_path, capture=root, protocol=name, register="off").plan().inputs
        for name in ("exact", "tracked")
    )
    for inputs, params, labels in ((exact, "params.npz", "labels"), (tracked, "params_noisy.npz", "labels_estimated")):
        assert inputs.params.name == inputs.motion.name == params
        assert inputs.labels is None and {path.parts[-3] for path in inputs.label_maps.values()} == {labels}
    assert tracked.protocol == "tracked"
    save_build(tmp_path, tracked, BuildConfig())
    assert load_build(tmp_path)[0] == tracked


def test_a_build_from_before_there_were_protocols_is_read(root, tmp_path):
    save_build(tmp_path, Build(run_folder=tmp_path, capture=root).plan().inputs, BuildConfig())
    content = json.loads((tmp_path / "build.json").read_text())
    del content["inputs"]["protocol"]
    (tmp_path / "build.json").write_text(json.dumps(content))
    assert load_build(tmp_path)[0].protocol is None


def test_label_maps_come_first_and_the_scans_own_labels_only_when_asked_for(root, tmp_path, caplog):
    def inputs(**options) -> BuildInputs:
        return Build(run_folder=tmp_path, capture=root, **options).plan().inputs

    assert inputs().labels is None and inputs(protocol="exact").labels is None
    assert inputs(label_source="scan").labels.name == "scan_000000_labels.npz"
    assert inputs(label_source="scan").label_maps == {}
    with pytest.raises(InputError, match=r"labels of the scan.*by protocol tracked"):
        inputs(label_source="scan", protocol="tracked")
    assert not caplog.records
    shutil.rmtree(root / "labels")
    assert inputs().labels.name == "scan_000000_labels.npz"
    assert "no label maps of frame 0" in caplog.text and "no estimate" in caplog.text
    with pytest.raises(InputError, match="label maps of its views"):
        inputs(label_source="views")
    (root / "scans" / "scan_000000_labels.npz").unlink()
    assert inputs().labels is None and inputs().label_maps == {}  # the body in the scan is to tell
    with pytest.raises(InputError, match="with --capture"):
        Build(run_folder=tmp_path, scan=root / "scans" / "scan_000000.ply", protocol="tracked").plan()


def test_held_out_cameras_do_not_vote(root, tmp_path):
    assert sorted(Build(run_folder=tmp_path, capture=root).plan().inputs.label_maps) == ["Ring0", "Ring1"]


# --- which protocol later commands read -----------------------------------------------------------------------------


def test_later_commands_keep_to_the_protocol_of_the_build(root, tmp_path, caplog):
    run = run_of(tmp_path / "run", root, "tracked")
    assert chosen_protocol(run, None, own_params=False) == "tracked"
    scene = open_scene(run, TrainInputs(root))
    assert scene.capture.protocol == "tracked" and scene.capture.params(0).transl[0, 0] == AWAY
    assert open_frame(run, TrainInputs(root), 0).capture.protocol == "tracked"
    with pytest.raises(
        InputError,
        match=r"received exact, for a template .* built by protocol tracked.*build OTHER --protocol exact.*--params",
    ):
        open_scene(run, TrainInputs(root, protocol="exact"))
    assert not caplog.records
    assert open_scene(run, TrainInputs(root, protocol="exact"), measures=True).capture.protocol == "exact"
    assert "was built by protocol tracked; the capture is read by protocol exact" in caplog.text
    given = TrainInputs(root, Path("params_noisy.npz"), protocol="exact")
    assert open_scene(run, given).capture.params(0).transl[0, 0] == AWAY


def test_a_run_without_a_protocol_is_not_trained_by_one(root, tmp_path):
    run = run_of(tmp_path / "run", root, None)
    assert open_scene(run, TrainInputs(root)).capture.protocol is None
    with pytest.raises(InputError, match="built without a protocol"):
        open_scene(run, TrainInputs(root, protocol="tracked"))
    assert chosen_protocol(write_dressed(tmp_path / "bare"), "tracked", own_params=False) == "tracked"


def test_a_capture_that_lacks_the_runs_protocol_is_refused(root, tmp_path):
    run = run_of(tmp_path / "run", root, "tracked")
    with pytest.raises(InputError, match=r"protocol tracked of capture other"):
        open_scene(run, TrainInputs(write_frames(tmp_path / "other")))


def test_the_truth_can_be_lost_without_a_training_by_protocol_tracked_noticing(root, tmp_path):
    """Were any of it read, digests or errors would tell."""
    run = run_of(tmp_path / "run", root, "tracked")
    before = open_scene(run, TrainInputs(root))
    for path in (root / "labels", root / "normals", root / "geometry"):
        shutil.rmtree(path)
    (root / "params" / "params.npz").unlink()
    (root / "scans" / "scan_000000_labels.npz").unlink()
    inputs = Build(run_folder=run, capture=root, protocol="tracked").plan().inputs
    assert inputs == load_build(run)[0]
    after = open_scene(run, TrainInputs(root))
    assert after.digests == before.digests and after.frame == before.frame
    assert all(np.array_equal(after.capture.params(f).transl, before.capture.params(f).transl) for f in range(FRAMES))
    assert not after.capture.presence("normal").any()


# --- the words ------------------------------------------------------------------------------------------------------


def test_files_of_a_protocol_are_what_its_name_says(root, tmp_path):
    found = {
        name: input_protocol(run_of(tmp_path / str(name), root, name), open_capture(root, protocol=name))
        for name in ("exact", "tracked", None)
    }
    words = {name: (one.name, one.parameters, one.labels, one.normals) for name, one in found.items()}
    assert words == {
        "exact": ("exact", "exact", "true", "none"),
        "tracked": ("tracked", "tracked", "estimated", "none"),
        # Without a protocol the files are the same as those that the protocol exact names.
        None: ("exact", "exact", "true", "none"),
    }
    scan = run_of(tmp_path / "scan", root, "exact", label_source="scan")
    assert input_protocol(scan, open_capture(root, protocol="exact")).name == "exact"
    driven = input_protocol(tmp_path / "tracked", open_capture(root, protocol="exact"))
    assert (driven.name, driven.parameters) == ("mixed", "mixed")


def test_figures_keep_their_protocol_where_run_and_capture_are_moved(root, tmp_path):
    """Labels and parameters were "not known" after a folder was renamed, and everything was measured anew."""
    place = tmp_path / "place"
    place.mkdir()
    root = root.rename(place / "capture")
    run = run_of(place / "run", root, "tracked")
    before = input_protocol(run, open_capture(root, protocol="tracked"))
    assert (before.name, before.labels) == ("tracked", "estimated")
    # Both together.
    place = place.rename(tmp_path / "renamed")
    run, root = place / "run", place / "capture"
    assert input_protocol(run, open_capture(root, protocol="tracked")) == before
    assert load_build(run)[0].scan == root / "scans" / "scan_000000.ply"
    # The capture alone: its files are the same if a stage of the build has seen their content.
    root = root.rename(tmp_path / "elsewhere")
    assert input_protocol(run, open_capture(root, protocol="tracked")).labels == "not known"
    (run / "20_segment").mkdir()
    seen = {"label_maps/Ring0": sha256_file(root / "labels_estimated" / "Ring0" / "Ring0_label000000.png")}
    seen["params"] = sha256_file(root / "params" / "params_noisy.npz")
    (run / "20_segment" / "manifest.json").write_text(json.dumps({"schema": SCHEMA, "inputs": seen}))
    assert input_protocol(run, open_capture(root, protocol="tracked")) == before
    for file in (root / "labels_estimated").rglob("*.png"):
        file.write_bytes(b"other labels")
    assert input_protocol(run, open_capture(root, protocol="tracked")).labels == "not known"


def test_what_a_capture_says_of_a_file_goes_before_the_name_of_a_protocol(root, tmp_path):
    """A protocol that calls itself tracked and names the true label maps is none."""
    content = json.loads((root / "capture.json").read_text())
    content["protocols"] = {"tracked": {**TRACKED, "labels": "labels"}}
    (root / "capture.json").write_text(json.dumps({**content, "inputs": {"labels": "true"}}))
    run = run_of(tmp_path / "run", root, "tracked")
    assert input_protocol(run, open_capture(root, protocol="tracked")).name == "mixed"


@pytest.mark.parametrize(
    ("protocol", "began", "word"), [("tracked", TRACKED, "tracked"), ("exact", EXACT, "mixed"), ("bare", {}, "tracked")]
)
def test_parameters_that_a_run_made_are_as_good_as_those_they_began_with(root, tmp_path, protocol, began, word):
    content = json.loads((root / "capture.json").read_text())
    content["protocols"] = {protocol: {**began, "labels": "labels_estimated"}}
    (root / "capture.json").write_text(json.dumps(content))
    run = write_dressed(tmp_path / "run")
    for file, stage in (("05_register", "registered"), ("66_refine", "refined")):
        (run / file).mkdir()
        stand(AWAY / 2).save(run / file / "params.npz")
        found = input_protocol(run, open_capture(root, protocol=protocol, params=run / file / "params.npz"))
        assert (found.parameters, found.stage) == (word, stage)
        assert f"parameters {word} ({stage}), labels" in found.sentence()


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("exact", "true", "true"), "exact"),
        (("exact", "true", "none"), "exact"),
        (("tracked", "estimated", "none"), "tracked"),
        (("tracked", "estimated", "estimated"), "tracked"),
        (("tracked", "estimated", "true"), "mixed"),
        (("tracked", "true", "none"), "mixed"),
        (("exact", "estimated", "none"), "mixed"),
        (("tracked", "not known", "none"), "not known"),
        (("mixed", "estimated", "none"), "mixed"),
    ],
)
def test_one_word_for_all_inputs(words, name):
    one = InputProtocol(*words, views_with_normals=3, training_views=7)
    assert one.name == name and one.caption("novel views").startswith(f"{name}: novel")
    assert ("(3 of 7 views)" in one.sentence()) == (words[2] != "none")
    assert InputProtocol.from_dict({**vars(one), "name": one.name}) == one


def test_a_training_without_the_normal_term_had_no_normals(root, tmp_path):
    run = run_of(tmp_path / "run", root, "exact")
    for camera in ("Ring0", "Ring1"):
        (root / "normals" / camera).mkdir()
        (root / "normals" / camera / f"{camera}_normal000000.png").touch()
    capture = open_capture(root, protocol="exact")
    assert input_protocol(run, capture).normals == "true"
    (run / "90_compensate").mkdir()
    numbers = {"training_frames": 4, "training_cameras": 7, "normals": "none"}
    (run / "90_compensate" / "manifest.json").write_text(json.dumps({"schema": SCHEMA, "numbers": numbers}))
    assert input_protocol(run, capture).normals == "none"


# --- the evaluation -------------------------------------------------------------------------------------------------


def test_covered_vertices_are_those_that_the_clothes_hide():
    template = dressed()
    assert not covered_vertices(template).any()  # the doll's dress is its own surface


@pytest.mark.long
def test_an_evaluation_prints_poses_against_exact_ones_and_refined_ones(root, tmp_path, capsys, caplog, monkeypatch):
    draw_no_surfaces(monkeypatch)
    caplog.set_level(logging.WARNING)
    run = write_models(run_of(tmp_path / "run", root, "tracked"), dressed())
    options = ("--device", "cpu", *QUICK, "--no-report", "--shown", "0")
    assert main(["evaluate", str(run), "--capture", str(root), *options]) == 0
    text = capsys.readouterr().out
    assert "poses in use against the exact ones" in text and "refined on" not in text
    report = EvalReport.load(run / "95_evaluate" / "metrics.json")
    assert list(report.poses) == ["training frames", "held-out frames"] and report.refined_poses == {}
    for error in report.poses.values():
        assert error.body_mm == pytest.approx(1e3 * AWAY) == error.joints_mm
        assert error.degrees == pytest.approx(0, abs=1e-6)
    assert report.poses["training frames"].frames == FRAMES - len(NOVEL)
    captions = [line for line in text.splitlines() if line.startswith("tracked: ")]
    assert len(captions) == len(list((run / "95_evaluate" / "tables").glob("*.txt")))

    (run / "66_refine").mkdir()
    stand(AWAY / 4).save(run / "66_refine" / "params_held_out.npz")
    assert main(["evaluate", str(run), "--capture", str(root), *options]) == 0
    text = capsys.readouterr().out
    assert "novel poses, poses refined on training cameras, " in text
    again = EvalReport.load(run / "95_evaluate" / "metrics.json")
    assert again.poses["held-out frames, refined on training cameras"].body_mm == pytest.approx(1e3 * AWAY / 4)
    assert again.models["student"].views == report.models["student"].views
    refined = again.refined_poses["student"].views
    assert set(refined) == {"novel_pose", "novel_pose_training_view"}
    assert refined["novel_pose"] != again.models["student"].views["novel_pose"]
    given = run / "66_refine" / "params_held_out.npz"
    assert main(["evaluate", str(run), "--capture", str(root), *options, "--params", str(given)]) == 0
    capsys.readouterr()
    directly = EvalReport.load(run / "95_evaluate" / "metrics.json").models["student"].views
    assert {name: directly[name] for name in refined} == refined
    assert main(["evaluate", str(run), "--capture", str(root), *options, "--held-out-poses", "tracked"]) == 0
    assert "poses refined" not in capsys.readouterr().out


@pytest.mark.long
def test_exact_poses_are_not_compared_with_themselves(root, tmp_path):
    run = write_models(run_of(tmp_path / "run", root, "exact"), dressed())
    assert main(["evaluate", str(run), "--capture", str(root), "--device", "cpu", *QUICK, "--no-report", "--json"]) == 0
    report = EvalReport.load(run / "95_evaluate" / "metrics.json")
    assert report.poses == {} and report.inputs.name == "exact"


# --- normals --------------------------------------------------------------------------------------------------------


def test_what_the_loss_goes_without_is_said_once(root, caplog):
    caplog.set_level(logging.INFO)
    config = Recipe(preset=training_preset("demo"))
    paper = Recipe(preset=training_preset("paper"))

    def told(capture, config, steps=STEPS) -> list[str]:
        caplog.clear()
        note_missing_normals(capture, config, steps)
        return [record.getMessage() for record in caplog.records]

    bare = open_capture(root)
    assert told(bare, config) == ["capture doll has no normal maps: those of followed clothes stand for them"]
    for alone in (paper, Recipe(preset=training_preset("cpu")), replace(config, teacher=False)):
        assert told(bare, alone) == ["capture doll has no normal maps: the loss has no normal term"]
    assert told(bare, config, ("fit",)) == []
    (root / "normals" / "Ring0").mkdir()
    for frame in range(4):
        (root / "normals" / "Ring0" / f"Ring0_normal{frame:06d}.png").touch()
    some = "4 of 28 training views have a normal map: the loss has no normal term in the others"
    assert told(open_capture(root), config) == [some]
