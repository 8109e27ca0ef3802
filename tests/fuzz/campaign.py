"""Many inputs in a process of their own, which a crash or a hang may end: the next process goes on after it."""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any

from tests.fuzz.doors import doors
from tests.fuzz.examine import CRASH, HANG, SECONDS, Findings, examine

_BATCH = 500


def campaign(name: str, inputs: int, *, first: int = 0) -> Findings:
    """Read so many mutated inputs through a door.

    Args:
        name: of the door.
        inputs: how many.
        first: the first seed.
    """
    total, seed, end = Findings(), first, first + inputs
    context = multiprocessing.get_context("spawn")
    while seed < end:
        at, results = context.Value("q", seed), context.SimpleQueue()
        worker = context.Process(target=_work, args=(name, seed, end, at, results), daemon=True)
        worker.start()
        outcome = _watched(worker, at, results, total)
        if outcome is None:
            break
        total.add(outcome, outcome, f"seed {at.value}")
        seed = at.value + 1
    return total


def _work(name: str, first: int, end: int, at: Any, results: SimpleQueue) -> None:
    def begun(seed: int) -> None:
        at.value = seed

    for start in range(first, end, _BATCH):
        with tempfile.TemporaryDirectory() as folder:
            findings = examine(doors()[name], range(start, min(start + _BATCH, end)), Path(folder), begun)
        results.put((findings.counts, findings.examples))
    results.put(None)


def _watched(worker: Any, at: Any, results: SimpleQueue, total: Findings) -> str | None:
    """Take in what a worker finds; how it ended before its time, None where it did not."""
    seen, since = at.value, time.monotonic()
    while True:
        while not results.empty():
            batch = results.get()
            if batch is None:
                worker.join()
                return None
            total.counts.update(batch[0])
            for what, text in batch[1].items():
                total.examples.setdefault(what, text)
        if not worker.is_alive() and results.empty():
            return CRASH
        if at.value != seen:
            seen, since = at.value, time.monotonic()
        elif time.monotonic() - since > 3 * SECONDS:
            worker.kill()
            worker.join()
            return HANG
        time.sleep(0.2)
