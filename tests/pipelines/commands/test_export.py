"""`smplxpp export --solid` and `--out`: what it writes, what it says, what it refuses."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh

from avatar.models.model_file import save_avatar
from avatar.runtime import AvatarPlayer, load_bundle
from pipelines.cli import main
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import STUDENT, TEMPLATE
from smplxpp.body import load_body
from smplxpp.core import BodyParams, GeometryWarning, SkinWeights
from smplxpp.template.template import Template
from tests.dolls.dancing import dance, write_dance_run
from tests.runtime.bundles import student


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "doll"
    (folder / TEMPLATE).parent.mkdir(parents=True)
    naked_template().save(folder / TEMPLATE)
    return folder


def naked_template() -> Template:
    body = load_body()
    count = len(body.v_template)
    return Template(
        vertices=body.v_template,
        faces=body.faces,
        vertex_labels=np.zeros(count),
        vertex_part=np.zeros(count),
        part_names=("body",),
        vertex_colors=np.full((count, 3), 128),
        weights=SkinWeights.from_dense(body.weights),
        body=body,
        betas=np.zeros(20),
        body_index=np.arange(count),
        scan_index=np.full(count, -1),
    )


def answer(capsys: pytest.CaptureFixture[str], *args: object) -> tuple[int, dict]:
    capsys.readouterr()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        status = main(["export", *map(str, args), "--json"])
    return status, json.loads(capsys.readouterr().out)


@pytest.mark.long
def test_a_print_is_one_watertight_piece_of_the_height_asked_for(run: Path, tmp_path: Path, capsys):
    status, report = answer(capsys, run, "--solid", tmp_path / "a.stl", "--height-mm", 90, "--thickness-mm", 1.5)
    assert status == 0 and report["components"] == 1
    made = trimesh.load(tmp_path / "a.stl")
    assert made.is_watertight and made.is_winding_consistent and made.body_count == 1
    assert made.extents[2] == pytest.approx(90, abs=0.1)
    assert made.volume / 1e3 == pytest.approx(report["volume_cm3"], rel=1e-3)
    assert report["file_volume_cm3"] == pytest.approx(report["volume_cm3"], rel=1e-5)
    assert 5 < report["wall_mm_median"] < 20


@pytest.mark.long
def test_it_takes_the_pose_and_names_what_is_wrong(run: Path, tmp_path: Path, capsys):
    params = BodyParams.rest(betas=2, expressions=0)
    params.save(tmp_path / "p.npz")
    out = tmp_path / "a.glb"
    status, report = answer(capsys, run, "--solid", out, "--params", tmp_path / "p.npz")
    assert status == 0 and out.is_file() and report["scale"] == 1.0
    size = np.ptp(trimesh.load(out, force="mesh").vertices, axis=0)
    np.testing.assert_allclose(size * 1e3, report["size_mm"], rtol=1e-4)
    for options, words in (
        (("--solid", tmp_path / "a.obj"), ".stl"),
        (("--solid", tmp_path / "b.stl", "--params", tmp_path / "p.npz", "--frame", 3), "an index below 1"),
        (("--solid", tmp_path / "b.stl", "--thickness-mm", 0), "thickness"),
    ):
        status, report = answer(capsys, run, *options)
        assert status == 2 and words in report["error"]["message"]
    assert not (tmp_path / "b.stl").exists()
    status, report = answer(capsys, tmp_path, "--solid", tmp_path / "b.stl")
    assert status == 2 and "finished template" in report["error"]["message"]


def test_one_of_out_and_solid_is_asked_for(run: Path, tmp_path: Path, capsys):
    for options in ((), ("--out", tmp_path / "a.avatar", "--solid", tmp_path / "a.stl")):
        status, report = answer(capsys, run, *options)
        assert status == 2 and report["error"]["subject"] == "options out and solid"
    status, report = answer(capsys, run, "--out", tmp_path / "a.xyz")
    assert status == 2 and ".avatar" in report["error"]["expected"]
    status, report = answer(capsys, run, "--out", tmp_path / "a.avatar")
    assert status == 2 and "smplxpp train" in report["error"]["remedy"]
    assert list(tmp_path.iterdir()) == []


def test_a_student_is_exported_with_a_motion(tmp_path: Path, capsys):
    run = write_dance_run(tmp_path / "run")
    (run / STUDENT).parent.mkdir()
    save_avatar(run / STUDENT, student("whole"))
    dance().save(tmp_path / "motion.npz")
    status, report = answer(
        capsys, run, "--out", tmp_path / "a.avatar", "--params", tmp_path / "motion.npz", "--licence", "CC0-1.0"
    )
    assert status == 0 and report["bytes"]["total"] == (tmp_path / "a.avatar").stat().st_size
    bundle = load_bundle(tmp_path / "a.avatar")
    assert (bundle.about.name, bundle.about.licence) == ("run", "CC0-1.0")
    assert bundle.about.provenance["student"] == sha256_file(run / STUDENT)
    assert len(AvatarPlayer(bundle, threads=1).motion) == report["frames"] == len(dance())
    status, report = answer(capsys, run, "--out", tmp_path / "b.avatar", "--exact", "--name", "Dancer")
    assert status == 0 and report["frames"] == 4  # the poses that training saw
    assert main(["export", str(run), "--out", str(tmp_path / "c.avatar")]) == 0
    assert "blend" in capsys.readouterr().out
