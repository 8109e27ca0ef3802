"""Khronos's validator finds nothing to say about what is written.

Needs node and the npm package gltf-validator: `npm install --prefix FOLDER gltf-validator`, then
`NODE_PATH=FOLDER/node_modules pytest tests/export`. Skips where either is missing.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from smplxpp.export import write_glb
from tests.export.templates import open_body_template, random_motion, random_template

SCRIPT = Path(__file__).with_name("validate_gltf.mjs")
CASES = {
    "three joints at rest": (lambda: random_template(joint_count=3), None, True),
    "every joint and expression": (random_template, 3, True),
    "without morph targets": (random_template, 3, False),
    "without expressions": (lambda: random_template(expressions=0), 0, True),
    "open body": (open_body_template, 52, True),
}


def validate(path: Path) -> dict:
    """The validator's report."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    run = subprocess.run(["node", str(SCRIPT), str(path)], capture_output=True, text=True, timeout=900, check=False)
    if run.returncode == 3:
        pytest.skip("the npm package gltf-validator is not in NODE_PATH")
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.mark.parametrize("case", CASES)
def test_validator_has_no_remarks(tmp_path, case):
    make, expressions, morph_targets = CASES[case]
    motion = None if expressions is None else random_motion(5, expressions=expressions)
    write_glb(tmp_path / "a.glb", make(), animation=motion, morph_targets=morph_targets)
    report = validate(tmp_path / "a.glb")
    assert report["issues"]["messages"] == []
    assert report["info"]["hasSkins"]
    assert report["info"]["animationCount"] == (motion is not None)


def test_validator_sees_a_damaged_file(tmp_path):
    path = tmp_path / "a.glb"
    write_glb(path, random_template())
    path.write_bytes(path.read_bytes().replace(b'"VEC4"', b'"VEC3"', 1))
    assert validate(path)["issues"]["numErrors"] > 0
