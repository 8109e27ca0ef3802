"""A run keeps out of its capture: before any work, for every command that writes one."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pipelines.cli import main
from pipelines.runs.folders import keep_out_of_capture, own_run_folder, refuse_old_run
from smplxpp.capture import find_problems, find_reference, open_capture
from smplxpp.core.errors import InputError

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"


@pytest.mark.parametrize(
    ("out", "refused"),
    [
        ("person", True),
        ("person/", True),
        ("person/../person", True),
        ("link", True),
        ("person/scans", True),
        ("person/mine/run", True),
        ("person/runs", True),
        ("link/rgbs/run", True),
        ("person/runs/one", False),
        ("link/runs/two", False),
        ("person2", False),
        (".", False),
        ("elsewhere", False),
    ],
)
def test_a_run_lies_beside_the_files_of_its_capture_or_in_its_folder_runs(tmp_path, out, refused):
    root = tmp_path / "person"
    (root / "scans").mkdir(parents=True)
    (tmp_path / "link").symlink_to(root)
    if refused:
        with pytest.raises(InputError, match=r"apart from the capture.*runs/"):
            keep_out_of_capture(tmp_path / out, root)
    else:
        keep_out_of_capture(tmp_path / out, root)
    keep_out_of_capture(tmp_path / out, None)


@pytest.mark.parametrize("name", ["08_capture", "70_fit", "ablation"])
def test_a_capture_does_not_take_the_place_of_a_stage(tmp_path, name):
    with pytest.raises(InputError, match=f"takes the place of {name}"):
        keep_out_of_capture(tmp_path, tmp_path / name / "person")
    keep_out_of_capture(tmp_path, tmp_path / "captures" / name)


@pytest.mark.parametrize(
    "command",
    [
        ("build", "CAPTURE", "--capture", "CAPTURE"),
        ("register", "CAPTURE", "--capture", "CAPTURE"),
        ("train", "CAPTURE", "--capture", "CAPTURE"),
        ("fit", "CAPTURE", "--capture", "CAPTURE"),
        ("evaluate", "CAPTURE", "--capture", "CAPTURE"),
        ("ablate", "CAPTURE", "--capture", "CAPTURE"),
        ("capture", "check", "CAPTURE", "--out", "CAPTURE"),
        ("capture", "convert", "CAPTURE", "--out", "CAPTURE"),
        ("capture", "degrade", "CAPTURE", "--out", "CAPTURE"),
        ("synth", "--out", "CAPTURE"),
    ],
    ids=" ".join,
)
def test_no_command_writes_into_a_captures_own_folder(tmp_path, capsys, command):
    root = tmp_path / "person"
    shutil.copytree(FIXTURE, root, ignore=shutil.ignore_patterns("geometry", "normals", "labels_estimated"))
    files = sorted(root.rglob("*"))
    assert main([part.replace("CAPTURE", str(root)) for part in command]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "apart from the capture" in said or "a new or an empty folder" in said
    assert sorted(root.rglob("*")) == files


@pytest.mark.long
def test_a_run_in_the_captures_folder_runs_is_no_part_of_the_capture(tmp_path):
    root = tmp_path / "person"
    shutil.copytree(FIXTURE, root, ignore=shutil.ignore_patterns("geometry", "normals", "labels_estimated"))
    before, reference = open_capture(root), find_reference(root)
    run = root / "runs" / "one"
    for name in ("scans", "rgbs", "params", "labels"):
        shutil.copytree(root / name, run / "08_capture" / name)
    after = open_capture(root)
    assert (after.format, after.frames, list(after.cameras)) == (before.format, before.frames, list(before.cameras))
    assert find_problems(after) == find_problems(before)
    assert find_reference(root) == reference


@pytest.mark.parametrize(("old", "new"), [("00_capture", "08_capture"), ("70_bind", "70_fit")])
def test_a_run_with_stages_of_old_names_is_refused_by_every_command_that_opens_one(tmp_path, capsys, old, new):
    run, photos = tmp_path / "run", str(FIXTURE)
    (run / old).mkdir(parents=True)
    refuse_old_run(run)  # a folder of that name is no stage
    (run / old / "manifest.json").write_text("{}")
    before = sorted(run.rglob("*"))
    commands = (
        ("build", str(run), "--capture", photos),
        ("register", str(run), "--capture", photos),
        ("reconstruct", str(run), "--capture", photos),
        ("fit", str(run), "--capture", photos),
        ("train", str(run), "--capture", photos),
        ("evaluate", str(run), "--capture", photos),
        ("ablate", str(run), "--capture", photos),
        ("inspect", str(run)),
        ("view", str(run)),
        ("label", str(run)),
        ("animate", str(run), "--params", str(FIXTURE / "params.npz"), "--out", str(tmp_path / "film.mp4")),
        ("talk", str(run), "--text", "Hello."),
        ("chat", str(run)),
        ("web", str(run)),
        ("export", str(run)),
    )
    for command in commands:
        assert main(list(command)) == 2, command
        message = " ".join(capsys.readouterr().err.split())
        assert "expected stages named as this version names them" in message and new in message, command
        assert f"received {old}, which an earlier version wrote" in message, command
    with pytest.raises(InputError, match=old), own_run_folder(run, ()):
        pass
    assert sorted(run.rglob("*")) == before
