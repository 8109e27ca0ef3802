"""`smplxpp metrics` over files and over folders of frames."""

from __future__ import annotations

import csv
import json
import warnings
from typing import get_args

import numpy as np
import pytest
import tyro

from pipelines.commands.metrics import Metrics, Preset, frame_number, pair_frames
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.mesh_files.mesh_io import write_ply
from smplxpp.metrics import presets


@pytest.fixture
def folders(tmp_path, plane):
    """Frames 1-3 in both folders, 2 of A broken, 4 only in A, 5 only in B; A lies 1, 2, 3 mm above B."""
    a, b = tmp_path / "a", tmp_path / "b"
    a.mkdir()
    b.mkdir()
    for frame in (1, 2, 3, 4):
        write_ply(a / f"pred_{frame:04d}.ply", plane(frame * 1e-3))
    (a / "pred_0002.ply").write_text("no mesh")
    for frame in (1, 2, 3, 5):
        write_ply(b / f"scan_{frame:06d}.ply", plane(0.0))
    return a, b


def test_the_presets_offered_are_those_that_exist():
    assert get_args(Preset) == tuple(presets())


def test_two_files_and_every_way_out(tmp_path, plane, capsys):
    a, b = tmp_path / "a.ply", tmp_path / "b.ply"
    gt = plane(0.0)
    write_ply(a, plane(0.002))
    write_ply(b, gt, face_properties={"label": np.where(gt.triangles[:, :, 0].mean(1) < 0, 3, 4)})
    command = tyro.cli(Metrics, args=[str(a), str(b), "--samples", "500", "--out", str(tmp_path / "o.json")])
    report = command.run()
    assert report["frames"][0]["p2s"] == pytest.approx(2.0, abs=1e-4)
    assert report["frames"][0]["labels"]["upper"]["chamfer"] == pytest.approx(2.0, abs=1e-4)
    assert json.loads((tmp_path / "o.json").read_text()) == report
    printed = capsys.readouterr().out
    assert "point to surface" in printed and "lower" in printed
    quiet = tyro.cli(Metrics, args=[str(a), str(b), "--samples", "500", "--json"])
    assert quiet.run()["frames"][0]["p2s"] == report["frames"][0]["p2s"]
    assert capsys.readouterr().out == ""


def test_folders_give_a_row_a_frame_and_name_what_was_left_out(folders, tmp_path, capsys):
    a, b = folders
    report = Metrics(a=a, b=b, samples=300, out=tmp_path / "rows.csv").run()
    assert [f["frame"] for f in report["frames"]] == ["pred_0001", "pred_0003"]
    assert report["over_frames"]["p2s"]["mean"] == pytest.approx(2.0, abs=1e-4)
    assert report["over_frames"]["p2s"]["std"] == pytest.approx(1.0, abs=1e-4)
    assert {s["frame"] for s in report["skipped"]} == {"pred_0002", "pred_0004.ply", "scan_000005.ply"}
    with (tmp_path / "rows.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(r["pred_to_gt.mean"]) for r in rows] == pytest.approx([1.0, 3.0], abs=1e-4)
    printed = capsys.readouterr().out
    assert "mean" in printed and "skipped" in printed and "pred_0004.ply" in printed


def test_frames_pair_by_name_before_number(tmp_path):
    for folder, names in (("a", ("x_1", "y_1")), ("b", ("y_1", "x_1", "x_2"))):
        (tmp_path / folder).mkdir()
        for name in names:
            (tmp_path / folder / f"{name}.ply").touch()
    pairs, skipped = pair_frames(tmp_path / "a", tmp_path / "b")
    assert [(n, p.name, q.name) for n, p, q in pairs] == [("x_1", "x_1.ply", "x_1.ply"), ("y_1", "y_1.ply", "y_1.ply")]
    assert [s["frame"] for s in skipped] == ["x_2.ply"]
    assert frame_number(tmp_path / "cam1_f00012.ply") == frame_number(tmp_path / "12.obj")
    for name in ("x_1", "x_2"):
        (tmp_path / "b" / f"{name}.ply").rename(tmp_path / "b" / f"other_{name}.ply")
    (tmp_path / "b" / "y_1.ply").rename(tmp_path / "b" / "z_1.ply")
    with pytest.raises(InputError, match="one file a frame"):
        pair_frames(tmp_path / "a", tmp_path / "b")


def test_labels_come_from_files_and_folders_of_files(folders, tmp_path, plane):
    a, b = folders
    labels = tmp_path / "labels"
    labels.mkdir()
    for frame in (1, 3):
        np.savez(labels / f"f{frame}.npz", face_labels=np.full(plane(0.0).face_count, frame))
    report = Metrics(a=a, b=b, samples=100, labels_b=labels, json=True).run()
    assert [list(f["labels"]) for f in report["frames"]] == [["hair"], ["upper"]]
    one = tmp_path / "one.npy"
    np.save(one, np.full(plane(0.0).face_count, 2))
    report = Metrics(a=a, b=b, samples=100, labels_a=one, json=True).run()
    assert [list(f["labels"]) for f in report["frames"]] == [["shoe"], ["shoe"]]
    np.save(one, np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="plain arrays"):
        Metrics(a=a / "pred_0001.ply", b=b / "scan_000001.ply", labels_a=one).run()


def test_units_scale_and_implausible_ones_warn(tmp_path, plane):
    a, b = tmp_path / "a.ply", tmp_path / "b.ply"
    write_ply(a, plane(0.3, half=100.0))
    write_ply(b, plane(0.0, half=100.0))
    report = Metrics(a=a, b=b, samples=100, units="cm", json=True).run()
    assert report["frames"][0]["p2s"] == pytest.approx(3.0, abs=1e-4)
    with pytest.warns(GeometryWarning, match="--units"):
        Metrics(a=a, b=b, samples=100, json=True).run()


@pytest.mark.parametrize("case", ["missing", "mixed", "empty", "nothing comparable", "suffix"])
def test_what_cannot_be_compared_is_refused(tmp_path, plane, case):
    mesh, folder, other = tmp_path / "m.ply", tmp_path / "f", tmp_path / "g"
    write_ply(mesh, plane(0.0))
    folder.mkdir()
    other.mkdir()
    a, b, out = mesh, mesh, None
    if case == "missing":
        b = tmp_path / "none.ply"
    elif case == "mixed":
        b = folder
    elif case == "empty":
        a, b = folder, other
    elif case == "nothing comparable":
        (folder / "1.ply").write_text("x")
        (other / "1.ply").write_text("x")
        a, b = folder, other
    else:
        out = tmp_path / "o.txt"
    with pytest.raises(InputError):
        Metrics(a=a, b=b, samples=10, out=out, json=True).run()


@pytest.mark.parametrize(
    ("factor", "offset", "words"),
    [
        (1000.0, 0.0, "units differ by 1000"),
        (0.1, 0.0, "units differ by 10"),
        (1.0, 1.9, "boxes share"),
        (1.0, 0.1, ""),
    ],
)
def test_pairs_that_hardly_belong_together_are_named(tmp_path, plane, factor, offset, words):
    a, b = tmp_path / "a.ply", tmp_path / "b.ply"
    moved = plane(0.0)
    write_ply(a, moved.with_vertices(factor * moved.vertices * 0.005 + [offset * 0.005, 0, 0]))
    write_ply(b, moved.with_vertices(0.005 * moved.vertices))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        frame = Metrics(a=a, b=b, samples=100, json=True, threshold_mm=(1.0, 5.0)).run()["frames"][0]
    assert (words in str(caught[0].message)) if words else not caught
    assert frame["hausdorff"] <= frame["hausdorff_upper"] <= frame["hausdorff"] + 0.02
    assert [scores["threshold_mm"] for scores in frame["scores"]] == [1.0, 5.0]


@pytest.mark.filterwarnings("ignore")  # for a kilometre
@pytest.mark.parametrize("height", [1.954e-8, 965.4, 96540.0])
def test_no_number_of_a_narrow_table_is_broken_in_two_lines(tmp_path, plane, height, capsys, monkeypatch):
    """Distances of 1.954e-05 and 9.654e+05 mm ended on a line of their own."""
    monkeypatch.setenv("COLUMNS", "80")
    a, b = tmp_path / "a.ply", tmp_path / "b.ply"
    write_ply(a, plane(height))
    write_ply(b, plane(0.0))
    Metrics(a=a, b=b, samples=100).run()
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    assert len(rows) == 2 and all(line.split("│")[1].strip() == "a" for line in rows), rows
