"""`smplxpp demo`: its commands in their order, one bundle for film and pages, one report when all is there."""

from __future__ import annotations

import sys
from pathlib import Path
from threading import Event

import pytest

from pipelines.commands import demo
from smplxpp.core.errors import InputError, MissingExtraError

STEPS = ("Build", "Train", "evaluate_beside", "Animate", "Web", "Talk", "export_bundle", "rewrite_report")
EVALUATE_BESIDE = demo.evaluate_beside


@pytest.fixture
def done(monkeypatch) -> list[tuple[str, tuple, dict]]:
    """The demo's commands with what each was given, none of which does anything."""
    calls: list[tuple[str, tuple, dict]] = []

    class Nothing:
        def run(self) -> dict[str, int]:
            return {"exit_status": 1}

    def recorded(name: str):
        return lambda *given, **options: (calls.append((name, given, options)), Nothing())[1]

    for name in STEPS:
        monkeypatch.setattr(demo, name, recorded(name))
    return calls


def test_film_and_pages_play_one_bundle_and_the_report_is_written_when_all_is_there(done, tmp_path, capsys):
    assert demo.Demo(tmp_path).run() == {"exit_status": 1}  # that of the build
    names = [name for name, _, _ in done]
    assert [name for name in names if name != "evaluate_beside"] == [
        "Build",
        "Train",
        "export_bundle",
        "Animate",
        "Web",
        "Talk",
        "rewrite_report",
    ]
    assert names.index("Train") < names.index("evaluate_beside") < names.index("rewrite_report")
    given = {name: {**options, "first": positional[:1]} for name, positional, options in done}
    assert given["Build"]["protocol"] == "tracked" and given["Train"]["preset"] == "demo"
    assert given["Train"]["no_report"]
    bundle = tmp_path / "me.avatar"
    assert given["Animate"]["run_folder"] == given["Web"]["source"] == bundle == given["Talk"]["first"][0]
    printed = "".join(capsys.readouterr().err.split())
    for file in ("report.html", "motion.mp4", "player.html", "me.avatar", "talking.html"):
        assert str(Path(tmp_path, file).resolve()) in printed


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
