"""`smplxpp demo`: its commands in their order, one bundle for film and pages, one report when all is there."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from threading import Event

import pytest
import torch

from pipelines.commands import demo
from smplxpp.core.errors import InputError, MissingExtraError

BESIDE = ("help_refine_beside", "evaluate_beside")
STEPS = ("Build", "Train", *BESIDE, "Animate", "Web", "Talk", "export_bundle", "rewrite_report")
EVALUATE_BESIDE, HELP_REFINE_BESIDE = demo.evaluate_beside, demo.help_refine_beside


@pytest.fixture
def done(monkeypatch) -> list[tuple[str, tuple, dict]]:
    """The demo's commands with what each was given, none of which does anything."""
    calls: list[tuple[str, tuple, dict]] = []

    class Nothing:
        def run(self, assembled: Callable[[], object] = lambda: None) -> dict[str, int]:
            assembled()
            return {"exit_status": 1}

    def recorded(name: str):
        return lambda *given, **options: (calls.append((name, given, options)), Nothing())[1]

    for name in STEPS:
        monkeypatch.setattr(demo, name, recorded(name))
    return calls


def test_film_and_pages_play_one_bundle_and_the_report_is_written_when_all_is_there(done, tmp_path, capsys):
    assert demo.Demo(tmp_path).run() == {"exit_status": 1}  # that of the build
    names = [name for name, _, _ in done]
    assert [name for name in names if name not in BESIDE] == [
        "Build",
        "Train",
        "Train",
        "export_bundle",
        "Animate",
        "Web",
        "Talk",
        "rewrite_report",
    ]
    last_training = len(names) - 1 - names[::-1].index("Train")
    assert last_training < names.index("evaluate_beside") < names.index("rewrite_report")
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
    calls = {name: (given, options) for name, given, options in reversed(done)}
    (run, _, stop), _ = calls["help_refine_beside"]
    assert run == tmp_path and stop.is_set()  # poses stand: nobody waits for help any more
    refined, trained_whole = (options for name, _, options in done if name == "Train")
    # Both find the same refinement, or the second would make it again.
    assert refined["refine_frames"] == trained_whole["refine_frames"] == demo.CHUNKS["refine_frames"]


def test_help_with_the_poses_that_fails_is_told_and_ends_nothing(tmp_path, monkeypatch, caplog):
    fails = """import sys; print('{"error": {"message": "no template."}}'); sys.exit(2)"""
    monkeypatch.setattr(demo, "own_program", lambda: ((sys.executable, "-c", fails), {}))
    HELP_REFINE_BESIDE(tmp_path, tmp_path, Event())
    assert "no template; see refine_help.log" in caplog.text


def test_without_the_extra_for_speech_the_report_is_written_all_the_same(done, tmp_path, monkeypatch, capsys):
    def missing(*given, **options):
        raise MissingExtraError("espeakng-loader", extra="talk", purpose="speaking")

    monkeypatch.setattr(demo, "Talk", missing)
    demo.Demo(tmp_path).run()
    assert done[-1][0] == "rewrite_report"
    printed = capsys.readouterr().err
    assert "she does not talk" in printed and "talking.html" not in printed


def test_an_evaluation_that_fails_beside_the_film_ends_the_demo_in_its_words(tmp_path, monkeypatch):
    answers = (
        """import sys; print('{"error": {"message": "no student."}}'); print("error", file=sys.stderr); sys.exit(2)"""
    )
    monkeypatch.setattr(demo, "own_program", lambda: ((sys.executable, "-c", answers), {}))
    with pytest.raises(InputError, match="evaluation of the demo: expected its figures, received no student"):
        demo.evaluate_beside(tmp_path, tmp_path, Event())
    assert (tmp_path / "evaluate.log").read_text() == "error\n"


def test_a_film_that_fails_ends_the_evaluation_beside_it(done, tmp_path, monkeypatch):
    def failing(*given, **options):
        raise InputError("film", expected="a place", received="none")

    waits = [sys.executable, "-c", "import time; time.sleep(600)"]
    monkeypatch.setattr(demo, "own_program", lambda: (waits, {}))
    monkeypatch.setattr(demo, "evaluate_beside", EVALUATE_BESIDE)
    monkeypatch.setattr(demo, "Animate", failing)
    with pytest.raises(InputError, match="film"):
        demo.Demo(tmp_path).run()
