"""`66_refine` in a run: made, skipped, made anew, taken by what comes after, shown in the report."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar.training.refinement.config import RefineConfig
from pipelines.cli import main
from pipelines.report.sections.training import refine_section, refinement_key_numbers, standing_refinement
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import REFINED_CAMERAS, REFINED_HELD_OUT_PARAMS, REFINED_PARAMS, REGISTERED_PARAMS, TEMPLATE
from pipelines.runs.stage import read_manifest
from pipelines.stages.refine import wants_refinement
from pipelines.stages.run_inputs import params_in_use, params_to_begin_with
from pipelines.stages.scene import TrainInputs, open_scene
from smplxpp.body import load_params
from smplxpp.capture import read_cameras
from smplxpp.core.errors import InputError
from tests.dolls.gesturing import FRAMES, NOVEL_POSES, disturbed, doll, gestures, write_gestures
from tests.pretended_cuda import pretended_cuda
from tests.training.refinement.test_refine import QUICK


def quick(seed: int = 0, cameras: bool = False, chunk_frames: int = 200) -> RefineConfig:
    return replace(QUICK, seed=seed, cameras=cameras, chunk_frames=chunk_frames)


@pytest.fixture(autouse=True)
def few_gaussians(monkeypatch):
    use_quick(monkeypatch)


def use_quick(patch: pytest.MonkeyPatch) -> None:
    """Refine with few Gaussians; the recipe is imported before the configuration that it takes over is replaced."""
    for module in ("avatar.training.recipe", "avatar.training.refinement.config"):
        patch.setattr(f"{module}.RefineConfig", quick)


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    root = write_gestures(tmp_path_factory.mktemp("captures") / "gestures")
    disturbed(gestures()).save(root / "params" / "params_noisy.npz")
    gestures().save(root / "params" / "params.npz")
    about = json.loads((root / "capture.json").read_text())
    about["inputs"] = {"parameters": {"params.npz": "exact", "params_noisy.npz": "tracked"}}
    (root / "capture.json").write_text(json.dumps(about))
    return root


def refine(run: Path, capture: Path, *options: str) -> int:
    noisy = str(capture / "params" / "params_noisy.npz")
    command = ["train", str(run), "--capture", str(capture), "--params", noisy, "--until", "refine"]
    return main([*command, "--device", "cpu", "--json", "--no-report", *options])


@pytest.fixture(scope="module")
def refined(capture, tmp_path_factory):
    run = doll().write_run(tmp_path_factory.mktemp("runs") / "gestures")
    with pytest.MonkeyPatch.context() as patch:
        use_quick(patch)
        assert refine(run, capture) == 0  # the capture says that these are tracked
    return run


@pytest.mark.slow
def test_a_refinement_on_cuda_is_that_of_the_cpu_and_stands_for_it(refined, capture, tmp_path, capsys):
    run = doll().write_run(tmp_path / "run")
    with pretended_cuda():
        assert refine(run, capture, "--device", "cuda") == 0
    there, here = load_params(run / REFINED_PARAMS), load_params(refined / REFINED_PARAMS)
    np.testing.assert_allclose(there.body_pose, here.body_pose, rtol=0, atol=1e-4)
    pictures = {path.name for path in (refined / "66_refine" / "pictures").iterdir()}
    assert pictures and pictures == {path.name for path in (run / "66_refine" / "pictures").iterdir()}
    key = read_manifest(run / "66_refine")["key"]
    assert refine(run, capture) == 0 and read_manifest(run / "66_refine")["key"] == key


def test_every_frame_has_a_row_and_held_out_frames_keep_theirs(refined):
    params, apart = load_params(refined / REFINED_PARAMS), load_params(refined / REFINED_HELD_OUT_PARAMS)
    start, held_out = disturbed(gestures()), NOVEL_POSES[0]
    assert len(params) == len(apart) == FRAMES
    np.testing.assert_allclose(params.transl[held_out], start.transl[held_out], atol=1e-12)
    np.testing.assert_allclose(params.body_pose[held_out], start.body_pose[held_out], atol=1e-9)
    assert np.abs(params.transl[0] - start.transl[0]).max() > 1e-4
    np.testing.assert_array_equal(params.transl[:held_out], apart.transl[:held_out])
    assert np.abs(apart.transl[held_out] - start.transl[held_out]).max() > 1e-4
    numbers = json.loads((refined / "66_refine" / "refinement.json").read_text())
    assert numbers["training"]["frames"] == list(range(held_out)) and numbers["held_out"]["frames"] == [held_out]


@pytest.mark.long
def test_it_stands_until_something_changes(refined, capture, capsys):
    assert refine(refined, capture) == 0
    assert json.loads(capsys.readouterr().out)["stages"]["refine"]["ran"] is False
    assert refine(refined, capture, "--seed", "1") == 0
    assert json.loads(capsys.readouterr().out)["stages"]["refine"]["ran"] is True
    assert refine(refined, capture) == 0


def test_what_comes_after_takes_the_refined_ones(refined, capture):
    noisy = capture / "params" / "params_noisy.npz"
    inputs = TrainInputs(capture, noisy)
    scene, before = open_scene(refined, inputs), open_scene(refined, inputs, refined=False)
    np.testing.assert_array_equal(scene.capture.params(2).transl, load_params(refined / REFINED_PARAMS).transl[2:3])
    np.testing.assert_array_equal(before.capture.params(2).transl, load_params(noisy).transl[2:3])
    assert scene.digests[REFINED_PARAMS] == sha256_file(refined / REFINED_PARAMS) != before.digests.get(REFINED_PARAMS)
    # Other parameters than those that it began with are taken as they are.
    other = capture / "params" / "params.npz"
    assert open_scene(refined, TrainInputs(capture, Path("params_noisy.npz"))).digests == scene.digests
    assert params_in_use(refined, other) == other and params_in_use(refined, noisy) == refined / REFINED_PARAMS
    with pytest.raises(InputError, match="Ring1"):
        open_scene(refined, TrainInputs(capture, noisy, hold_out=("Ring1",)))


@pytest.mark.long
def test_corrected_cameras_are_taken_with_the_poses(capture, tmp_path, capsys):
    run, inputs = doll().write_run(tmp_path / "run"), TrainInputs(capture, capture / "params" / "params_noisy.npz")
    assert refine(run, capture, "--refine-poses", "off", "--refine-cameras") == 2
    assert "--refine-poses on" in capsys.readouterr().err
    assert refine(run, capture, "--refine-cameras") == 0
    scene, before = open_scene(run, inputs), open_scene(run, inputs, refined=False)
    corrected = {camera.name: camera for camera in read_cameras(run / REFINED_CAMERAS)}
    splits = scene.capture.splits
    assert set(corrected) == set(splits.train_cameras) and REFINED_CAMERAS in scene.digests
    for name, camera in scene.capture.cameras.items():
        given = before.capture.cameras[name]
        np.testing.assert_array_equal(camera.K, given.K)
        if name in corrected:
            np.testing.assert_allclose(camera.cam_from_world, corrected[name].cam_from_world, atol=1e-12)
            assert np.abs(camera.cam_from_world - given.cam_from_world).max() > 0
        else:
            np.testing.assert_array_equal(camera.cam_from_world, given.cam_from_world)
    # Without the option they are right again, and nothing stays behind.
    assert refine(run, capture) == 0
    assert not (run / REFINED_CAMERAS).exists()


def test_registered_parameters_come_before_the_captures_own(tmp_path):
    assert params_to_begin_with(tmp_path, None) is None
    (tmp_path / "05_register").mkdir()
    gestures().save(tmp_path / REGISTERED_PARAMS)
    assert params_in_use(tmp_path, None) == tmp_path / REGISTERED_PARAMS
    assert params_in_use(tmp_path, Path("given.npz")) == Path("given.npz")


def test_whether_poses_are_refined(refined, capture, tmp_path):
    run = doll().write_run(tmp_path / "run")
    exact, tracked = TrainInputs(capture, Path("params.npz")), TrainInputs(capture, Path("params_noisy.npz"))
    assert not wants_refinement(run, exact, "auto") and wants_refinement(run, tracked, "auto")
    assert wants_refinement(run, exact, "on") and not wants_refinement(run, tracked, "off")
    with pytest.raises(InputError, match="66_refine"):
        wants_refinement(refined, TrainInputs(capture, capture / "params" / "params_noisy.npz"), "off")


def test_a_refinement_of_another_template_is_not_taken(refined, capture, tmp_path):
    run = shutil.copytree(refined, tmp_path / "run")
    it = doll().template
    replace(it, vertex_colors=it.vertex_colors // 2).save(run / TEMPLATE)
    noisy = capture / "params" / "params_noisy.npz"
    assert params_in_use(run, noisy) == noisy
    assert standing_refinement(run, sha256_file(run / TEMPLATE)) is None


def test_the_report_shows_it(refined):
    record = standing_refinement(refined, sha256_file(refined / TEMPLATE))
    assert record is not None
    section = refine_section(record)
    assert len(section.comparisons) == 4 and len(section.pictures) == 4
    loss = next(curve for curve in section.curves if "loss" in curve.title)
    assert set(loss.lines) == {"before", "after"} and len(loss.lines["after"][0]) == NOVEL_POSES[0]
    assert any("held-out" in text for text in section.text) and section.checks
    (number,) = refinement_key_numbers(record)
    assert number.value.endswith("degrees")
    seen = read_manifest(refined / "66_refine")["numbers"]["seen"]
    assert seen["cameras"] == ["Ring0", "Ring1", "Ring2", "Ring3"] and NOVEL_POSES[0] not in seen["frames"]


@pytest.mark.long
def test_a_process_that_helps_leaves_the_end_to_another_one(capture, tmp_path, capsys):
    run, alone = (doll().write_run(tmp_path / name) for name in ("run", "alone"))
    chunks, helps = ("--refine-frames", "3"), ("--stage", "refine", "--refine-help")

    def helped(*more: str) -> bool:
        assert refine(run, capture, *chunks, *helps, *more) == 0
        return json.loads(capsys.readouterr().out)["finished"]

    assert refine(run, capture, *chunks, "--refine-help") == 2 and "--stage refine" in capsys.readouterr().err
    assert not helped("--max-minutes", "1e-6")  # it stops after a chunk
    assert helped() and (run / "66_refine_work").is_dir() and not (run / "66_refine").exists()
    # Another one finds all sums there, so that no limit of time stops it.
    assert refine(run, capture, *chunks, "--stage", "refine", "--max-minutes", "1e-6") == 0
    assert json.loads(capsys.readouterr().out)["finished"] and not (run / "66_refine_work").exists()
    assert helped()  # it stands
    assert refine(alone, capture, *chunks) == 0
    made, whole = (load_params(folder / REFINED_PARAMS).as_dict() for folder in (run, alone))
    for name, array in whole.items():
        np.testing.assert_array_equal(made[name], array)


@pytest.mark.long
def test_a_refinement_ends_within_the_limit_of_time_and_goes_on(capture, tmp_path, capsys):
    run, stops = doll().write_run(tmp_path / "run"), 0
    while True:
        assert refine(run, capture, "--max-minutes", "1e-6") == 0
        answer = json.loads(capsys.readouterr().out)
        if answer["finished"]:
            break
        stops += 1
        assert not (run / REFINED_PARAMS).exists() and (run / "66_refine_work").is_dir()
    # Of two passes over the training frames and two over the held-out ones, the first of each is followed by others.
    assert stops == 2 and (run / REFINED_PARAMS).is_file()
