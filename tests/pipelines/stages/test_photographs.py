"""The photographs of the reference frame tell a scan from its mirror image."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.commands.build import Build
from pipelines.runs.artefacts import load_params_of_run, load_scan
from pipelines.runs.layout import TEMPLATE
from pipelines.stages.build_config import BuildConfig, BuildInputs, load_build, save_build
from smplxpp.build.completeness import photograph_checks
from smplxpp.core.mesh import TriangleMesh
from smplxpp.template.template import Template
from tests.capture.scene import make_scene
from tests.capture.writers import write_simple

FIXTURE = Path(__file__).resolve().parents[3] / "data" / "fixtures" / "person"


@pytest.fixture(scope="module")
def built(person_run):
    """Template, parameters, scan and colours of a finished build."""
    scan, colors, _ = load_scan(person_run)
    return Template.load(person_run / TEMPLATE), load_params_of_run(person_run), scan, colors


@pytest.fixture
def inputs(tmp_path) -> BuildInputs:
    return Build(run_folder=tmp_path, capture=FIXTURE).plan().inputs


def test_a_capture_that_counts_from_one_has_its_first_frame_for_a_reference(tmp_path):
    """Recorders and ffmpeg number from 1; the build asked for frame 0 of a capture that has frames 1 and 3."""
    root = write_simple(make_scene(), tmp_path / "set")
    (root / "capture.json").unlink(missing_ok=True)
    for path in sorted([*(root / "rgbs").glob("*/*"), *(root / "masks").glob("*/*")], reverse=True):
        number = int(path.stem[-6:])
        path.rename(path.with_name(f"{path.stem[:-6]}{2 * number + 1:06d}{path.suffix}"))
    build = Build(run_folder=tmp_path / "run", capture=root)
    assert build.config().frame == 1 and replace(build, frame=3).config().frame == 3
    assert Build(run_folder=tmp_path / "run", capture=FIXTURE).config().frame == 0
    assert Build(run_folder=tmp_path / "run", capture=tmp_path / "none").config().frame == 0
    assert Build(run_folder=tmp_path / "run", scan=tmp_path / "me.ply").config().frame == 0


def test_a_build_of_a_capture_looks_at_its_photographs(person_run):
    metrics = json.loads((person_run / "metrics.json").read_text())
    (check,) = (c for c in metrics["checks"] if c["name"] == "photographs between the scan and its mirror image")
    assert check["status"] == "pass" and check["value"] < 0.35
    seen = metrics["stages"]["65_validate"]["photographs"]
    # Cam004 is held out.
    assert seen["views"] == ["Cam001", "Cam002", "Cam003", "Cam005", "Cam006", "Face1", "Face2"]
    assert seen["unread"] == []


@pytest.mark.long
def test_a_mirrored_scan_in_a_symmetric_pose_is_told(built, inputs):
    template, params, scan, colors = built
    mirrored = TriangleMesh(scan.vertices * [-1, 1, 1], np.ascontiguousarray(scan.faces[:, ::-1]))
    (check,), _ = photograph_checks(template, params, mirrored, colors, inputs)
    assert check.status == "warn" and check.value > 0.65


def test_a_scan_without_colours_or_a_build_without_photographs_has_no_check(built, inputs):
    template, params, scan, colors = built
    assert photograph_checks(template, params, scan, np.full_like(colors, 180), inputs) == ([], {})
    assert photograph_checks(template, params, scan, colors, replace(inputs, photographs={})) == ([], {})


@pytest.mark.long
def test_photographs_that_cannot_be_read_are_left_out_and_counted(built, inputs, tmp_path):
    template, params, scan, colors = built
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"no image")
    files = {name: inputs.photographs[name] for name in ("Cam001", "Cam002")}
    unread = replace(inputs, photographs={**files, "Cam003": broken, "Elsewhere": files["Cam001"]})
    (check,), numbers = photograph_checks(template, params, scan, colors, unread)
    assert check.status == "pass" and "2 views, 2 cannot be read" in check.explanation
    assert numbers["views"] == ["Cam001", "Cam002"] and len(numbers["unread"]) == 2
    for cameras in (None, broken):
        checks, numbers = photograph_checks(template, params, scan, colors, replace(unread, cameras=cameras))
        assert checks == [] and numbers["views"] == [] and len(numbers["unread"]) == 1


def test_a_capture_of_many_cameras_gives_a_few_photographs_and_none_held_out(tmp_path):
    root = tmp_path / "capture"
    shutil.copytree(FIXTURE / "scans", root / "scans")
    shutil.copytree(FIXTURE / "params", root / "params")
    for k in range(40):
        folder = root / "rgbs" / f"C{k:02d}"
        folder.mkdir(parents=True)
        (folder / f"C{k:02d}_rgb000000.JPG").write_bytes(b"")
    (root / "capture.json").write_text(json.dumps({"novel_views": ["C00", "C39"]}))
    shutil.copy(FIXTURE / "cameras.json", root)
    found = Build(run_folder=tmp_path / "run", capture=root, label_source="scan").plan().inputs
    assert list(found.photographs)[::7] == ["C01", "C38"] and len(found.photographs) == 8
    assert found.cameras == root / "cameras.json"
    save_build(tmp_path, found, BuildConfig())
    assert load_build(tmp_path) == (found, BuildConfig())


def test_a_build_from_before_there_were_photographs_is_read(tmp_path, inputs):
    save_build(tmp_path, inputs, BuildConfig())
    content = json.loads((tmp_path / "build.json").read_text())
    del content["inputs"]["photographs"]
    (tmp_path / "build.json").write_text(json.dumps(content))
    assert load_build(tmp_path)[0] == replace(inputs, photographs={})
