"""`smplxpp demo`: its commands in their order, one bundle for film and pages, one report when all is there."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from pipelines.commands import demo
from smplxpp.core.errors import InputError, MissingExtraError

BESIDE = ("poses_beside", "evaluation_beside")
COMMANDS = ("Build", "Train", *BESIDE, "say", "Animate", "Web", "Talk", "export_bundle", "rewrite_report")
POSES_BESIDE, EVALUATION_BESIDE = demo.poses_beside, demo.evaluation_beside


@pytest.fixture
def done(monkeypatch) -> list[tuple[str, tuple, dict]]:
    """The demo's commands with what each was given, none of which does anything."""
    calls: list[tuple[str, tuple, dict]] = []

    class Nothing:
        def __init__(self, name: str) -> None:
            self.name = name

        def run(self, assembled: Callable[[], object] = lambda: None) -> dict[str, int]:
            assembled()
            return {"exit_status": 1}

        def begin(self) -> None:
            calls.append((f"{self.name} begins", (), {}))

        def failure(self) -> None:
            calls.append((f"{self.name} ends", (), {}))

        def close(self) -> None:
            pass

    def recorded(name: str):
        return lambda *given, **options: (calls.append((name, given, options)), Nothing(name))[1]

    for name in COMMANDS:
        monkeypatch.setattr(demo, name, recorded(name))
    return calls


def test_film_and_pages_play_one_bundle_and_the_report_is_written_when_all_is_there(done, tmp_path, capsys):
    assert demo.Demo(tmp_path).run() == {"exit_status": 1}  # that of the build
    names = [name for name, _, _ in done if name != "say"]  # from a thread, at any time
    # Processes are started at the very beginning, and begin when what they read is there.
    assert names == [
        *BESIDE,
        "Build",
        "poses_beside begins",
        "Train",
        "poses_beside ends",
        "Train",
        "evaluation_beside begins",
        "export_bundle",
        "Animate",
        "Web",
        "Talk",
        "evaluation_beside ends",
        "rewrite_report",
    ]
    given = {name: {**options, "first": positional[:1]} for name, positional, options in done}
    assert given["Build"]["protocol"] == "tracked" and given["Train"]["preset"] == "demo"
    assert given["Train"]["no_report"]
    bundle = tmp_path / "me.avatar"
    assert given["Animate"]["run_folder"] == given["Web"]["source"] == bundle == given["Talk"]["first"][0]
    printed = "".join(capsys.readouterr().err.split())
    for file in ("report.html", "motion.mp4", "player.html", "me.avatar", "talking.html"):
        assert str(Path(tmp_path, file).resolve()) in printed


def test_another_process_begins_with_the_poses_when_the_template_stands_and_both_have_one_thread(
    done, tmp_path, monkeypatch
):
    threads: list[tuple[str | None, int]] = []
    trained, before = demo.Train, torch.get_num_threads()

    def train(**options):
        threads.append((options.get("stage"), torch.get_num_threads()))
        return trained(**options)

    monkeypatch.setattr(demo, "Train", train)
    torch.set_num_threads(2)
    try:
        demo.Demo(tmp_path).run()
    finally:
        torch.set_num_threads(before)
    assert threads == [("refine", 1), (None, 2)]
    refined, trained_whole = (options for name, _, options in done if name == "Train")
    # All find the same refinement, or another one would make it again.
    assert demo.POSES.items() <= refined.items() and demo.POSES.items() <= trained_whole.items()


def answering(monkeypatch, program: str) -> None:
    """Let a program stand for every process of the demo."""
    monkeypatch.setattr(demo, "own_program", lambda module: ((sys.executable, "-c", program), {}))


def test_help_with_the_poses_that_fails_is_told_and_ends_nothing(done, tmp_path, monkeypatch, caplog):
    answering(monkeypatch, """import sys; print('{"error": {"message": "no template."}}'); sys.exit(2)""")

    def failed(*given):
        helper = POSES_BESIDE(*given)
        helper.failure()
        return helper

    monkeypatch.setattr(demo, "poses_beside", failed)
    demo.Demo(tmp_path).run()
    assert "no template; see refine_help.log" in caplog.text and done[-1][0] == "rewrite_report"


def test_a_helper_imports_first_and_begins_when_told_or_ends_with_its_parent(tmp_path, monkeypatch):
    begin, did, parents = tmp_path / "begin", [], iter((1, 1, 1, 2))
    monkeypatch.setattr(demo, "import_module", did.append)
    monkeypatch.setattr(demo, "run_module", lambda name, run_name: did.append(f"{name} {' '.join(sys.argv[1:])}"))
    monkeypatch.setattr(sys, "argv", [])
    monkeypatch.setattr(demo.os, "getppid", lambda: next(parents))
    monkeypatch.setattr(demo, "sleep", lambda seconds: begin.touch())
    given = (begin, ["pipelines.runs.layout"], ["evaluate", "RUN"])
    demo.begin_when_told(*given)
    assert did == ["pipelines.runs.layout", "pipelines.cli evaluate RUN"]
    begin.unlink()
    demo.begin_when_told(*given)  # its parent is another one
    assert did[2:] == ["pipelines.runs.layout"]


def test_without_the_extra_for_speech_the_report_is_written_all_the_same(done, tmp_path, monkeypatch, capsys):
    def missing(*given, **options):
        raise MissingExtraError("espeakng-loader", extra="talk", purpose="speaking")

    monkeypatch.setattr(demo, "Talk", missing)
    demo.Demo(tmp_path).run()
    assert done[-1][0] == "rewrite_report"
    printed = capsys.readouterr().err
    assert "she does not talk" in printed and "talking.html" not in printed


def test_an_evaluation_that_fails_beside_the_film_ends_the_demo_in_its_words(done, tmp_path, monkeypatch):
    answering(
        monkeypatch,
        """import sys; print('{"error": {"message": "no student."}}'); print("error", file=sys.stderr); sys.exit(2)""",
    )
    monkeypatch.setattr(demo, "evaluation_beside", EVALUATION_BESIDE)
    with pytest.raises(InputError, match="evaluation of the demo: expected its figures, received no student"):
        demo.Demo(tmp_path).run()
    assert (tmp_path / "evaluate.log").read_text() == "error\n" and done[-1][0] == "Talk"


def test_a_film_that_fails_ends_the_evaluation_beside_it(done, tmp_path, monkeypatch):
    def failing(*given, **options):
        raise InputError("film", expected="a place", received="none")

    answering(monkeypatch, "import time; time.sleep(600)")
    monkeypatch.setattr(demo, "evaluation_beside", EVALUATION_BESIDE)
    monkeypatch.setattr(demo, "Animate", failing)
    with pytest.raises(InputError, match="film"):
        demo.Demo(tmp_path).run()
