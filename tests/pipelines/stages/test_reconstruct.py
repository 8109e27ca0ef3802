"""`smplxpp reconstruct` on the fixture: what it writes, sees, refuses, resumes."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from avatar.reconstruct import SurfaceConfig
from pipelines.commands.reconstruct import ReconstructCommand
from pipelines.runs.layout import RECONSTRUCT_STAGE, reconstructed_scan
from pipelines.stages import reconstruct as stage_module
from pipelines.stages.build_config import ReconstructInputs, load_reconstruct
from pipelines.stages.neural_surface import neural_method
from pipelines.stages.reconstruct import reconstruct_capture
from pipelines.stages.scene import seen_of
from smplxpp.build.reconstruct import open_photographs, unit_cube_of, usable_cameras, usable_frames
from smplxpp.capture import open_capture
from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh, write_ply
from smplxpp.reconstruct import ReconstructConfig
from smplxpp.reconstruct.hull import solid_status
from smplxpp.reconstruct.neus2 import UnitCube
from tests.conftest import ROOT

FIXTURE = ROOT / "data" / "fixtures" / "person"
COARSE = {"cell": 30.0, "hull_only": True, "json": True}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reconstruct") / "run"
    return folder, ReconstructCommand(capture=FIXTURE, run_folder=folder, frame="0", **COARSE).run()


def test_it_writes_a_closed_coloured_scan_in_metres_and_a_page(run):
    folder, said = run
    raw = read_raw_mesh(folder / reconstructed_scan(0))
    assert solid_status(TriangleMesh(raw.vertices, raw.faces))[0] == "NoError"
    assert raw.vertex_colors is not None and raw.vertex_colors.std() > 10
    assert np.ptp(raw.vertices[:, 1]) == pytest.approx(1.65, abs=0.15)
    arrays = np.load(folder / RECONSTRUCT_STAGE / "scan_000000.npz")
    assert len(arrays["confidence"]) == len(arrays["seen"]) == len(raw.vertices)
    page = (folder / "reconstruct.html").read_text()
    assert "Reconstruction" in page and page.count("data:image/jpeg") >= 4
    assert said["scans"] == {"0": str(folder / reconstructed_scan(0))}


def test_held_out_cameras_and_frames_are_not_seen_and_that_is_recorded(run):
    folder, _ = run
    splits = open_capture(FIXTURE).splits
    from pipelines.runs.stage import StageRecord, read_manifest

    seen = seen_of(StageRecord(folder / RECONSTRUCT_STAGE, read_manifest(folder / RECONSTRUCT_STAGE), ran=False))
    assert seen.cameras == set(splits.train_cameras) and splits.novel_view_cameras
    assert seen.frames == {0}
    with pytest.raises(InputError, match="held-out"):
        usable_frames(open_capture(FIXTURE), (splits.novel_pose_frames[0],))


def test_hold_out_takes_the_place_of_the_captures_own():
    capture = open_capture(FIXTURE)
    names = usable_cameras(capture, ("Cam001", "Face1"))
    assert set(names) == set(capture.cameras) - {"Cam001", "Face1"}
    with pytest.raises(InputError, match="hold-out"):
        usable_cameras(capture, ("Cam999",))
    with pytest.raises(InputError, match="all held out"):
        usable_cameras(capture, tuple(capture.cameras))


def test_it_stands_and_is_made_anew_for_other_options(run):
    folder, _ = run
    again = ReconstructCommand(capture=FIXTURE, run_folder=folder, frame="0", **COARSE).run()
    assert not again["ran"]
    assert load_reconstruct(folder) == ReconstructInputs(FIXTURE, (0,), refine=False, cell_mm=30.0)
    other = ReconstructCommand(
        capture=FIXTURE, run_folder=folder, frame="0", **{**COARSE, "cell": 40.0}, no_report=True
    ).run()
    assert other["ran"] and other["cell_mm"] == pytest.approx(40.0)


@pytest.mark.long
def test_frames_that_were_finished_before_a_kill_are_not_made_again(tmp_path, monkeypatch):
    inputs = ReconstructInputs(FIXTURE, (0, 2), refine=False, cell_mm=40.0)
    made, whole = [], stage_module._keep_frame

    def killed(folder, frame, *rest):
        if made:
            raise KeyboardInterrupt
        made.append(frame)
        whole(folder, frame, *rest)

    monkeypatch.setattr(stage_module, "_keep_frame", killed)
    with pytest.raises(KeyboardInterrupt):
        reconstruct_capture(tmp_path, inputs)

    def counted(folder, frame, *rest):
        made.append(frame)
        whole(folder, frame, *rest)

    monkeypatch.setattr(stage_module, "_keep_frame", counted)
    record = reconstruct_capture(tmp_path, inputs)
    assert made == [0, 2]
    assert record.manifest["numbers"]["seen"]["frames"] == [0, 2]
    assert {path.name for path in record.folder.glob("*.ply")} == {"scan_000000.ply", "scan_000002.ply"}
    assert not (tmp_path / f"{RECONSTRUCT_STAGE}_work").exists()


@pytest.fixture()
def copied(tmp_path):
    root = tmp_path / "capture"
    shutil.copytree(FIXTURE, root, ignore=shutil.ignore_patterns("geometry", "labels*", "normals", "scans", "params"))
    return root


def test_a_capture_without_masks_is_refused(copied, tmp_path):
    shutil.rmtree(copied / "masks")
    with pytest.raises(InputError, match="masks of its photographs"):
        reconstruct_capture(tmp_path / "run", ReconstructInputs(copied, (0,)))


def test_a_damaged_photograph_is_left_out_and_named(copied, tmp_path):
    (copied / "rgbs" / "Cam002" / "Cam002_rgb000000.jpg").write_bytes(b"no image")
    record = reconstruct_capture(tmp_path / "run", ReconstructInputs(copied, (0,), refine=False, cell_mm=40.0))
    content = json.loads((record.folder / "reconstruction.json").read_text())["frames"]["0"]
    assert any("Cam002 left out" in words for words in content["problems"])
    assert "Cam002" not in content["views"]


def test_two_cameras_are_refused_before_work(tmp_path):
    held_out = tuple(open_capture(FIXTURE).cameras)[2:]
    with pytest.raises(InputError, match="at least 4 cameras"):
        reconstruct_capture(tmp_path, ReconstructInputs(FIXTURE, (0,), hold_out=held_out))


def test_a_frame_that_is_not_there_is_refused():
    with pytest.raises(InputError, match="frame"):
        ReconstructCommand(capture=FIXTURE, run_folder=FIXTURE, frame="99").inputs()
    inputs = ReconstructCommand(capture=FIXTURE, run_folder=FIXTURE, frame="all").inputs()
    assert inputs.frames is None
    capture = open_photographs(inputs)
    assert set(usable_frames(capture, None)) == set(capture.splits.train_frames)
    assert replace(inputs, frames=(3,)).frames == (3,)


def test_another_programs_mesh_is_taken_and_put_into_the_cameras_world(run, tmp_path):
    folder, _ = run
    raw = read_raw_mesh(folder / reconstructed_scan(0))
    mesh = TriangleMesh(0.5 * raw.vertices + 0.5, raw.faces)
    write_ply(tmp_path / "neus2.ply", mesh)
    with pytest.raises(InputError, match="--mesh"):
        reconstruct_capture(tmp_path / "run", ReconstructInputs(FIXTURE, mesh=tmp_path / "neus2.ply"))
    said = ReconstructCommand(
        capture=FIXTURE, run_folder=tmp_path / "run", mesh=tmp_path / "neus2.ply", json=True, no_report=True
    ).run()
    found = read_raw_mesh(tmp_path / "run" / reconstructed_scan(0))
    assert found.vertices == pytest.approx(raw.vertices, abs=1e-5)
    content = json.loads((tmp_path / "run" / RECONSTRUCT_STAGE / "reconstruction.json").read_text())
    assert content["frames"]["0"]["space"] == "cube of scale 0.5"
    assert said["unseen"] < 0.8


def test_the_unit_cube_of_transform_json_is_read(tmp_path):
    assert unit_cube_of(tmp_path) is None
    (tmp_path / "transform.json").write_text(json.dumps({"from_na": True, "scale": 0.7, "offset": [0.1, 0.2, 0.3]}))
    assert unit_cube_of(tmp_path) == UnitCube(0.7, (0.1, 0.2, 0.3))


def test_a_neural_surface_needs_a_gpu_or_the_word(tmp_path, monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="sdf") as caught:
        ReconstructCommand(capture=FIXTURE, run_folder=tmp_path / "run", method="sdf").run()
    assert "--device cpu" in caught.value.remedy
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match="neither --mesh nor --hull-only"):
        ReconstructCommand(capture=FIXTURE, run_folder=tmp_path / "run", method="sdf", hull_only=True).run()


@pytest.mark.long
def test_a_neural_surface_on_the_cpu_is_a_stage_like_others(tmp_path):
    surface = SurfaceConfig(
        **{"iterations": 2, "rays": 32, "samples": 8, "levels": 2, "finest": 16, "log2_entries": 8},
        **{"hull_cell": 0.06, "cell": 0.04},
    )
    config = ReconstructConfig(cell=0.04)
    method = neural_method(config, surface, "cpu")
    record = reconstruct_capture(tmp_path, ReconstructInputs(FIXTURE, (0,), cell_mm=40.0), method=method)
    assert record.manifest["config"]["method"]["name"] == "sdf"
    assert "avatar.reconstruct.neural_surface" in record.manifest["code"]
    raw = read_raw_mesh(tmp_path / reconstructed_scan(0))
    assert solid_status(TriangleMesh(raw.vertices, raw.faces))[0] == "NoError"
    again = reconstruct_capture(tmp_path, ReconstructInputs(FIXTURE, (0,), cell_mm=40.0), method=method)
    assert not again.ran
