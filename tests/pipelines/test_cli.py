"""The `smplxpp` command: help, errors in words, `--json`, the exit status."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import warnings
from importlib import import_module
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import tyro

from avatar.losses.perceptual_weights import load_lpips
from pipelines.cli import COMMANDS, main
from pipelines.commands.help import EXPERT_OPTIONS, INPUT_OPTIONS, NEED, NEEDED_OPTIONS, known_options, options_of
from pipelines.runs.folders import own_run_folder
from smplxpp.core import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_files.mesh_io import write_ply
from tests.runs.stages import add_stage

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
SCAN, PARAMS = FIXTURE / "scans" / "scan_000000.ply", FIXTURE / "params" / "params.npz"


@pytest.fixture
def cube(tmp_path) -> Path:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
    write_ply(tmp_path / "cube.ply", TriangleMesh(corners, np.array(faces)))
    return tmp_path / "cube.ply"


def fails(capsys, *args: object) -> str:
    """The words on stderr of a command that the user got wrong."""
    assert main([str(arg) for arg in args]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "Traceback" not in captured.err
    return " ".join(captured.err.split())


@pytest.mark.parametrize("args", [[], ["--help"], ["-h"], ["help"]])
def test_help_names_every_command(args, capsys):
    assert main(args) == 0
    text = " ".join(capsys.readouterr().out.split())
    for name, (_, _, line) in COMMANDS.items():
        assert f"smplxpp {name}" in text and line in text


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_of_a_command_is_explained(name, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert main([*name.split(), "--help"]) == 0
    text = capsys.readouterr().out
    # An option is its name and its value, then words on the same line or the next; a line fits a terminal.
    rows = text.splitlines()
    assert max(map(len, rows)) < 80
    for row, after in pairwise([*rows, ""]):
        if row.startswith("  -"):
            assert re.search(r"\S {2,}\S.+", row) or after.startswith(" " * 20), row
    assert re.search("default: *[)]|default: None|[{,(]None|VALUE", text) is None
    # The parser knows every option that the help names; what is required comes first.
    module, cls, _ = COMMANDS[name]
    command = getattr(import_module(module), cls)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # newer versions of tyro warn of it
        parser = tyro.extras.get_parser(command, config=(tyro.conf.FlagCreatePairsOff,))
    there = {option for action in parser._actions for option in action.option_strings} - {"-h", "--help"}
    assert there == set(known_options(command))
    required = {action.dest for action in parser._actions if action.required}
    assert {o.name.removeprefix("--") for o in options_of(command) if o.group != NEED}.isdisjoint(required)


def test_groups_of_options_name_options_that_there_are():
    commands = [getattr(import_module(module), cls) for module, cls, _ in COMMANDS.values()]
    there = {option for command in commands for option in known_options(command)}
    assert {f"--{name}" for name in NEEDED_OPTIONS | INPUT_OPTIONS | EXPERT_OPTIONS} <= there
    assert not INPUT_OPTIONS & EXPERT_OPTIONS


def test_out_has_a_short_name_everywhere_and_mistakes_are_guessed(capsys, tmp_path):
    assert main(["params", "convert", str(PARAMS), "-o", str(tmp_path / "x.npz"), "--frames", "0:1"]) == 0
    assert (tmp_path / "x.npz").is_file()
    capsys.readouterr()
    text = fails(capsys, "build", "x", "--capure", "y")
    assert "perhaps --capture" in text and "smplxpp build --help" in text
    assert "no command 'bild'; did you mean build?" in fails(capsys, "bild", "x")
    assert "did you mean check?" in fails(capsys, "capture", "chek", "x")


def test_a_group_of_commands_has_help(capsys):
    assert main(["params", "--help"]) == 0
    text = capsys.readouterr().out
    assert "params convert" in text and "smplxpp build" not in text


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"smplxpp {version('smplxpp')}\n"


def test_unknown_commands_are_answered_with_the_known(capsys):
    assert "Known: build, " in fails(capsys, "bild") and "; known: build, " in fails(capsys, "xyzzy")
    assert "Known: params convert" in fails(capsys, "params", "converd")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["build", "x"], "either --capture or --scan"),
        (["build", "x", "--scan", SCAN, "--keypoints", FIXTURE], "with --capture"),
        (["build", "x", "--capture", "nowhere"], "an existing folder, received nowhere"),
        (["build", "x", "--capture", FIXTURE, "--frame", "99"], "frame"),
        (["build", "x", "--capture", FIXTURE, "--budgets", "hat", "500"], "hat"),
        (["build", "x", "--capture", FIXTURE, "--clearance-mm", "nan"], "received nan"),
        (["build", "x", "--capture", FIXTURE, "--seed", "-1"], "at least 0"),
        (["build", SCAN, "--capture", FIXTURE], "another folder"),
        (["inspect", "nowhere"], "smplxpp build"),
        (["animate", "nowhere", "--params", PARAMS, "--out", "x.gif"], "smplxpp build"),
        (["metrics", SCAN, "nowhere.ply"], "existing file"),
        (["metrics", SCAN, FIXTURE], "two files or two folders"),
        (["metrics", SCAN, SCAN, "--seed", "-1"], "at least 0"),
        (["view", "x", "--port", "abc"], "a whole number, received 'abc'"),
        (["view", "x", "--port"], "a whole number, received none"),
        (["export", "x", "--out", "a.glb", "--joint-names", "maximo"], "perhaps mixamo, received 'maximo'"),
        (["build", "x", "--capture", FIXTURE, "--clearance-mm", "1mm"], "a number, received '1mm'"),
        (["params", "convert", SCAN, "--out", "x.npz"], ".json"),
        (["params", "convert", PARAMS, "--out", "x.npz", "--frames", "a:b"], "START:STOP"),
    ],
)
def test_mistakes_are_named_with_what_helps(args, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = fails(capsys, *args)
    assert "error: " in text and "expected" in text and "received" in text and words in text
    assert list(tmp_path.iterdir()) == []


def test_labels_of_views_that_are_not_there(capsys, tmp_path):
    capture = tmp_path / "capture"
    capture.mkdir()
    for part in ("scans", "params"):
        (capture / part).symlink_to(FIXTURE / part)
    text = fails(capsys, "build", tmp_path / "x", "--capture", capture, "--label-source", "views")
    assert "--labels" in text and not (tmp_path / "x").exists()


def test_an_unknown_option_ends_with_status_2_and_nothing_on_stdout(capsys):
    text = fails(capsys, "inspect", "run", "--jsn")
    assert "--jsn" in text and "perhaps --json" in text
    with pytest.raises(SystemExit) as exit_:  # what the parser says itself
        main(["inspect", "run", "--json", "more"])
    captured = capsys.readouterr()
    assert exit_.value.code == 2 and captured.out == "" and "more" in captured.err


def test_errors_of_the_system_are_words_too(capsys, cube):
    assert "File exists" in fails(capsys, "metrics", cube, cube, "--samples", 50, "--out", cube / "x.csv")


def test_memory_that_is_not_there_is_said_in_words(capsys, cube, monkeypatch):
    def read(path: Path) -> None:
        raise MemoryError("Unable to allocate 93.1 GiB for an array with shape (50000, 250000)")

    monkeypatch.setattr("pipelines.commands.metrics.read_mesh", read)
    said = fails(capsys, "metrics", cube, cube)
    assert "93.1 GiB" in said and "smaller" in said


def test_an_interrupt_while_modules_load_is_no_traceback():
    program = """
import sys
class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "smplxpp":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupt())
from pipelines import main
sys.exit(main())
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=900, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


def test_an_error_is_json_when_json_was_asked_for(capsys):
    assert main(["inspect", "nowhere", "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["type"] == "InputError" and error["remedy"] and error["received"] in error["message"]


def test_json_is_all_that_stdout_gets(capsys, tmp_path, cube):
    add_stage(tmp_path / "run", "08_capture")
    for args in (
        ["inspect", tmp_path / "run"],
        ["metrics", cube, cube, "--samples", "100"],
        ["params", "convert", PARAMS, "--out", tmp_path / "p.npz"],
        ["build", tmp_path / "b", "--capture", FIXTURE, "--until-stage", "08_capture"],
    ):
        assert main([*map(str, args), "--json"]) == 0
        assert isinstance(json.loads(capsys.readouterr().out), dict)


@pytest.mark.long
def test_warnings_are_words_without_lines_of_code(tmp_path, cube):
    huge = tmp_path / "huge.ply"
    write_ply(huge, TriangleMesh(np.array([[0, 0, 0], [500, 0, 0], [0, 500, 0]], float), np.array([[0, 1, 2]])))
    done = subprocess.run(
        [sys.executable, "-m", "pipelines.cli", "metrics", str(cube), str(huge), "--samples", "100"],
        capture_output=True,
        text=True,
        timeout=900,
        check=True,
    )
    text = " ".join(done.stderr.split())
    assert "WARNING" in text and "units" in text and ".py:" not in text and "warnings.warn" not in text


@pytest.mark.parametrize(
    ("command", "option"),
    [("build", "--out"), ("register", "-o"), ("reconstruct", "--out"), ("train", "--run"), ("ablate", "--run")],
)
def test_options_of_earlier_versions_that_named_the_run_are_explained(capsys, command, option):
    text = fails(capsys, command, option, "x", "--capture", "y")
    assert f"option {option}" in text and f"smplxpp {command} RUN" in text


@pytest.mark.long
def test_a_first_build_that_fails_leaves_no_folder(capsys, tmp_path, cube):
    build = ("--scan", cube, "--units", "mm")  # a person of one millimetre
    assert "a person" in fails(capsys, "build", tmp_path / "run", *build)
    assert not (tmp_path / "run").exists()
    # A folder that was there before stays, and so does one with anything else than records of what was asked for.
    (tmp_path / "kept").mkdir()
    fails(capsys, "build", tmp_path / "kept", *build)
    assert (tmp_path / "kept" / "build.json").is_file()
    with pytest.raises(InputError), own_run_folder(tmp_path / "begun", ()):
        (tmp_path / "begun" / "08_capture").mkdir()
        raise InputError("x", expected="y", received="z")
    assert (tmp_path / "begun" / "08_capture").is_dir()


def test_only_a_package_that_is_missing_is_called_missing(tmp_path, monkeypatch):
    """A library that did not load, and a package that its own package lacks, were answered with "not installed"."""
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("lpips", "trimesh"):
        monkeypatch.delitem(sys.modules, name, raising=False)
        (tmp_path / f"{name}.py").write_text("import a_package_that_is_not_there")
    with pytest.raises(ModuleNotFoundError, match="a_package_that_is_not_there"):
        load_lpips()
    with pytest.raises(ModuleNotFoundError, match="a_package_that_is_not_there"):
        TriangleMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]).to_trimesh()
