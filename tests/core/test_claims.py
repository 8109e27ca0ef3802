"""Whether the process that has claimed a file still works."""

from __future__ import annotations

import os
import subprocess
import sys

from smplxpp.core.files import paths as claims


def test_a_process_runs_until_it_has_ended(monkeypatch):
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    assert claims.process_runs(child.pid) and claims.process_runs(os.getpid())
    child.communicate(b"\n", timeout=900)
    assert not claims.process_runs(child.pid) and not claims.process_runs(0)


def test_windows_is_not_asked_because_that_would_interrupt_the_process(monkeypatch):
    monkeypatch.setattr(claims.os, "name", "nt")
    monkeypatch.setattr(claims.os, "kill", lambda *given: 1 / 0)
    assert claims.process_runs(os.getpid())


def test_the_age_of_a_file_is_by_the_clock_of_its_disk(tmp_path):
    file = tmp_path / "claim"
    file.touch()
    os.utime(file, (0.0, file.stat().st_mtime - 100.0))
    assert 100.0 <= claims.age_of(file) < 1000.0
    assert list(tmp_path.iterdir()) == [file]
