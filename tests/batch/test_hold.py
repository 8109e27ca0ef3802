"""Who works on a batch: one process at a time, on whatever file system, and what is left of one that was killed."""

from __future__ import annotations

import json
import multiprocessing
import os
import socket
import time
from pathlib import Path

import pytest

from pipelines.batch import hold as module
from pipelines.batch.hold import Hold, at_work, read_holder
from smplxpp import InputError


def keep(path: str, ready, leave) -> None:
    """Hold a file in another process until it is told to leave."""
    with Hold(Path(path), subject="batch"):
        ready.set()
        leave.wait(600)


def test_a_second_process_is_refused_by_name_until_the_first_is_gone(tmp_path):
    path = tmp_path / ".batch.lock"
    context = multiprocessing.get_context("spawn")
    ready, leave = context.Event(), context.Event()
    other = context.Process(target=keep, args=(str(path), ready, leave))
    other.start()
    assert ready.wait(600)
    with pytest.raises(InputError, match=f"one on {socket.gethostname()}, process {other.pid}"):
        Hold(path, subject="batch").take()
    assert at_work(path)["pid"] == other.pid
    other.kill()  # as the system does: nothing is cleared up
    other.join()
    assert read_holder(path)["pid"] == other.pid and not at_work(path)
    with Hold(path, subject="batch"):
        assert read_holder(path)["pid"] == os.getpid()
    assert not read_holder(path)


def test_another_machine_counts_as_long_as_its_heart_beats(tmp_path, monkeypatch):
    """Where locks of the system are each machine's own, as with `nolock` or `localflock`."""
    path = tmp_path / ".job.lock"
    path.write_text(json.dumps({"host": "node7", "pid": 1, "since": "2026-01-01T00:00:00Z", "mark": "m"}))
    with pytest.raises(InputError, match="node7"):
        Hold(path, subject="anna").take()
    assert at_work(path)["host"] == "node7"
    past = time.time() - 300
    os.utime(path, (past, past))
    assert not at_work(path)
    with Hold(path, subject="anna", beat=0.02) as mine:
        # The other machine comes back and writes its mark: who was replaced sees it at the next beat.
        path.write_text(json.dumps({"host": "node7", "pid": 1, "mark": "m"}))
        until = time.monotonic() + 60
        while not mine.lost and time.monotonic() < until:
            time.sleep(0.01)
        assert mine.lost
    assert read_holder(path)["host"] == "node7"  # the new holder's file is left as it is


def test_a_file_system_without_locks_is_guarded_by_the_heartbeat(tmp_path, monkeypatch):
    def none(handle: int) -> bool:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(module, "try_lock", none)
    path = tmp_path / ".batch.lock"
    with Hold(path, subject="batch", beat=0.02):
        with pytest.raises(InputError, match=f"process {os.getpid()}"):
            Hold(path, subject="batch").take()
        first = path.stat().st_mtime_ns
        until = time.monotonic() + 60
        while path.stat().st_mtime_ns == first and time.monotonic() < until:
            time.sleep(0.01)
        assert path.stat().st_mtime_ns > first
    with Hold(path, subject="batch"):
        pass
