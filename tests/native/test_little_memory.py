"""Where the memory ends, a native entry point says so: the process goes on."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ENTRY_POINTS = ("draw_mesh", "draw_maps", "straighten", "compare", "splat", "bind")

ENVIRONMENT = {
    "OMP_NUM_THREADS": "2",
    "OPENBLAS_NUM_THREADS": "1",
    # Large memory goes back to the system when it is freed: every call has to ask for it again.
    "MALLOC_MMAP_THRESHOLD_": "32768",
    "MALLOC_ARENA_MAX": "1",
}


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of the address space are Linux's")
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.long
def test_every_entry_point_ends_in_a_memory_error(threads):
    done = subprocess.run(
        [sys.executable, "-m", "tests.native.little_memory", str(threads)],
        cwd=ROOT,
        env={**os.environ, **ENVIRONMENT},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, f"{done.returncode}: {done.stdout}{done.stderr}"
    found = dict(line.split(" ", 1) for line in done.stdout.splitlines())
    assert set(found) == set(ENTRY_POINTS)
    for name, outcome in found.items():
        word, failed, _ = outcome.split(" ")
        assert word == "ended" and int(failed) > 5, f"{name}: {outcome}"
    assert sum(int(outcome.split(" ")[2]) for outcome in found.values()) > 0  # some of them the kernels' own
