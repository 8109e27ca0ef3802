"""Standard streams that take no more, or not every letter; errors of the system in words."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from pipelines.cli import COMMANDS, main
from pipelines.commands import terminal
from pipelines.commands.terminal import OutputError, error_in_words, standard_streams
from smplxpp.core.errors import InputError
from tests.runs.stages import add_stage

ROOT = Path(__file__).resolve().parents[3]
ASKED = [["--help"], ["params", "--help"], ["--version"], ["inspect", "nowhere", "--json"]]
ASKED += [[*name.split(), "--help"] for name in COMMANDS]


def status_of(args: list[str]) -> int | str | None:
    """What the command ends with, by returning or by leaving."""
    try:
        return main(args)
    except SystemExit as exit_:
        return exit_.code


@pytest.mark.parametrize("args", ASKED, ids=" ".join)
def test_a_full_stdout_is_one_line_and_no_success(args, monkeypatch, capfd):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert status_of(args) == 2
    err = capfd.readouterr().err
    assert "Traceback" not in err and err.splitlines()[-1] == "error: standard output: No space left on device"


@pytest.mark.parametrize("args", ASKED, ids=" ".join)
def test_a_pipe_that_nobody_reads_ends_the_command_quietly(args, monkeypatch, capfd):
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert status_of(args) == 141
    assert capfd.readouterr().err.count("error") == ("nowhere" in args)  # the user's own mistake is still told


@pytest.mark.parametrize("option", [[], ["--json"]])
def test_the_answer_of_a_command_to_a_full_stdout(option, tmp_path, monkeypatch, capfd):
    add_stage(tmp_path / "run", "08_capture")
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(["inspect", str(tmp_path / "run"), *option]) == 2
    assert capfd.readouterr().err == "error: standard output: No space left on device\n"


@pytest.mark.long
def test_nothing_is_left_for_the_interpreters_end(tmp_path):
    run = [sys.executable, "-m", "pipelines.cli", "--help"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(run, stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT, timeout=900)
    assert done.returncode == 2 and done.stderr == "error: standard output: No space left on device\n"
    done = subprocess.run(f"'{sys.executable}' -m pipelines.cli --version >&-", shell=True, cwd=ROOT, timeout=900)
    assert done.returncode == 0


def test_what_stderr_refuses_changes_nothing(monkeypatch, capfd):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stderr", full)
        assert main(["inspect", "nowhere"]) == 2
        assert main(["--version"]) == 0
    assert capfd.readouterr().out.startswith("smplxpp ")


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_letters_that_the_encoding_lacks_are_escaped(encoding, tmp_path, monkeypatch, capfd):
    run = tmp_path / "Ω\udcff"  # a letter, and a byte of a name that is not UTF-8
    add_stage(run, "08_capture")
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding=encoding, errors="strict"))
    for args in (["inspect", str(run)], ["inspect", str(run), "--json"], ["--help"]):
        assert main(args) == 0
    written = raw.getvalue().decode(encoding)
    assert "\\u03a9" in written and "\\udcff" in written


def test_errors_of_streams_are_not_those_of_pipes():
    """Rich ends the program by itself at a BrokenPipeError."""
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as pipe, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", pipe)
        with standard_streams(), pytest.raises(OutputError):
            Console().print("words")
            sys.stdout.flush()


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "free some space"),
        (errno.EDQUOT, "quota"),
        (errno.EFBIG, "ulimit -f"),
        (errno.EROFS, "can be written"),
        (errno.EACCES, "permissions"),
        (errno.ENAMETOOLONG, "shorten"),
        (errno.EIO, "system's log"),
        (errno.EMFILE, "ulimit -n"),
    ],
)
def test_what_the_system_refuses_comes_with_file_and_remedy(number, remedy, tmp_path):
    path = tmp_path / "deep" / "file.npz"
    words = error_in_words(OSError(number, os.strerror(number), str(path)))
    assert words.startswith(f"{path}: {os.strerror(number)}") and remedy in words.lower()
    assert ("MB are free" in words) == (number in (errno.ENOSPC, errno.EDQUOT))


def test_notes_follow_the_error(tmp_path):
    error = InputError("scan", expected="faces", received="none")
    error.add_note("Look at the file.")
    assert error_in_words(error) == "scan: expected faces, received none. Look at the file."


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space\nleft"), InputError("a\nb", expected="c", received="d")]
)
def test_errors_take_one_line(error, monkeypatch, capsys):
    def fails(*_: object) -> int:
        raise error

    monkeypatch.setattr("pipelines.cli._run", fails)
    assert main(["inspect", "x"]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ") and captured.err.count("\n") == 1


def test_an_interrupt_is_quiet(monkeypatch, capsys):
    def interrupted(*_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("pipelines.cli._run", interrupted)
    assert main(["inspect", "x"]) == 130
    assert capsys.readouterr().err.count("\n") == 1


def test_a_job_without_a_terminal_gets_a_line_from_time_to_time(capsys, monkeypatch):
    monkeypatch.setattr(terminal, "EVERY_SECONDS", 0.02)
    with terminal.stage_progress(4) as step:
        step("20_segment", False)
        time.sleep(0.3)  # one long step, which reports nothing
        step("20_segment", True)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 3 and set(lines[:3]) == {"20_segment  0 %  0:00 min"}
    with terminal.stage_progress(4, enabled=False) as step:
        step("20_segment", False)
        time.sleep(0.1)
    assert capsys.readouterr().err == ""
