"""A training killed (SIGKILL) at random moments ends with the bits of one that was not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from safetensors.torch import load_file

from avatar.training.engine.checkpoints import STATE_FILE
from avatar.training.engine.loop import METRICS_FILE
from avatar.training.engine.metrics_log import read_metrics
from tests.dolls.toy import same_state

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = Path(__file__).with_name("killed_training.py")


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_ten_kills_change_no_bit(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(SCRIPT), str(tmp_path), "10"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    moments = json.loads(done.stdout)
    assert len(moments) == 10 and moments == sorted(moments) and moments[-1] > 20  # it came on between kills
    killed, whole = (load_file(tmp_path / name / "end.safetensors") for name in ("killed", "whole"))
    assert same_state(killed, whole)
    logs = [
        [{k: v for k, v in e.items() if k not in ("seconds", "iterations_per_second")} for e in read_metrics(path)]
        for path in (tmp_path / "killed" / METRICS_FILE, tmp_path / "whole" / METRICS_FILE)
    ]
    assert logs[0] == logs[1] and logs[1][-1]["iteration"] == 330
    assert {path.name for path in (tmp_path / "killed").iterdir()} == {"end.safetensors", METRICS_FILE, STATE_FILE}
