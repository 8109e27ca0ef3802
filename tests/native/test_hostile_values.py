"""NaN, infinity, huge and tiny numbers, empty arrays, indices and sizes out of range: refused or drawn, no crash."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ENTRY_POINTS = ("draw_mesh", "draw_maps", "splat", "splat_unchecked", "compare", "bind", "straighten")


@pytest.mark.long
def test_entry_points_draw_or_refuse_whatever_comes():
    # In a process of its own, where a signal would be seen.
    done = subprocess.run(
        [sys.executable, "-m", "tests.native.hostile_values", "1", "60"],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "2"},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, f"{done.returncode}: {done.stdout}{done.stderr}"
    rows = [line.split() for line in done.stdout.splitlines()]
    assert tuple(row[0] for row in rows) == ENTRY_POINTS
    assert all(int(drawn) > 5 for _, drawn, _ in rows), rows
    assert sum(int(refused) for _, _, refused in rows) > 60
