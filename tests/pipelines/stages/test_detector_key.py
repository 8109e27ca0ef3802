"""A detector that gives other points makes the stage that asks it run anew."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.runs.layout import LOCATE_STAGE
from pipelines.runs.stage import StageOutput
from pipelines.stages.build import PARTS, build
from pipelines.stages.build_config import BuildConfig, BuildInputs
from tests.detect.keypoint_models import write_card, write_model


def test_another_model_of_the_same_name_is_asked_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    asked = []

    def run(folder, build):
        asked.append(build.config.detector)
        return StageOutput([], {"confidence": 1.0})

    monkeypatch.setitem(PARTS, LOCATE_STAGE, replace(PARTS[LOCATE_STAGE], work=run))
    scan = tmp_path / "scan.ply"
    scan.write_bytes(b"a scan")
    model = write_card(write_model(tmp_path / "pose.onnx", "simcc"))
    inputs, config = BuildInputs("me", scan, None, locates=True), BuildConfig(detector=str(model))

    def again() -> int:
        build(tmp_path / "run", inputs, config, last=LOCATE_STAGE)
        return len(asked)

    assert again() == 1 and again() == 1
    write_card(write_model(model, "heatmap"))
    assert again() == 2 and again() == 2
    write_card(model, padding=1.5)
    assert again() == 3
