"""Rigged files opened by other programs: bones, expressions, texture coordinates, pictures, size, normals.

Readers that this Python lacks are looked for in the Pythons of $FOREIGN_PYTHONS (`a/bin/python:b/bin/python`), three.js
in NODE_PATH; others are skipped. `pytest -m slow -s tests/export/test_foreign_readers.py` prints the table of
docs/exports.md.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smplxpp.core import InputError
from smplxpp.export.fbx import blender_command
from smplxpp.export.vrm import in_vrm_pose
from smplxpp.template.template import Template
from smplxpp.template.texture import Texture, encode_texture
from tests.export.templates import open_body_template, with_part
from tests.export.test_glb_validator import validate

HERE = Path(__file__).parent
PYTHONS = [sys.executable, *filter(None, os.environ.get("FOREIGN_PYTHONS", "").split(os.pathsep))]
READERS = {
    "three": (".glb", ".vrm", ".fbx", ".obj"),
    "assimp": (".glb", ".vrm", ".fbx", ".obj"),
    "bpy": (".glb", ".fbx", ".usdc", ".usdz", ".obj"),
    "ufbx": (".fbx",),
    "usd": (".usdc", ".usdz"),
    "trimesh": (".glb", ".vrm", ".obj"),
}
VALIDATORS = {
    "khronos": (".glb", ".vrm"),
    "vrm-schema": (".vrm",),
    "vrm-addon": (".vrm",),
    "usd-rules": (".usdc", ".usdz"),
}
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def dressed() -> Template:
    """The open body with a part on its chin, and a texture whose every vertex has a place."""
    body = open_body_template()
    chin = body.weights.dense()[:, body.body.joint_names.index("jaw")] > 0.99
    template = with_part(body, "beard", 1, body.faces[chin[body.faces].all(axis=1)][:60], 0.01)
    rng = np.random.default_rng(0)
    colors, _ = encode_texture([rng.integers(0, 256, (64, 64, 3)).astype(np.uint8)], [])
    places = rng.uniform(size=(template.vertex_count, 2))
    texture = Texture(uv=places, face_uv=template.faces, picture=np.zeros(2, np.int64), colors=colors)
    return replace(template, texture=texture)


@pytest.fixture(scope="module")
def files(dressed, tmp_path_factory) -> dict[str, Path]:
    folder, out = tmp_path_factory.mktemp("rigged"), {}
    for suffix in sorted({suffix for suffixes in READERS.values() for suffix in suffixes}):
        if suffix == ".fbx":
            try:
                blender_command()
            except InputError:
                continue
        # A folder each, so that no reader finds another file's pictures.
        out[suffix] = folder / suffix[1:] / f"anna{suffix}"
        out[suffix].parent.mkdir()
        dressed.export(out[suffix])
    return out


def read(reader: str, path: Path) -> dict:
    """What a reader finds, by the first Python that has it."""
    commands = [[python, str(HERE / "foreign_readers.py"), reader] for python in PYTHONS]
    if reader == "three":
        commands = [["node", str(HERE / "load_three.mjs")]] if shutil.which("node") else []
    for command in commands:
        run = subprocess.run([*command, str(path)], capture_output=True, text=True, timeout=900, check=False)
        if run.returncode != 3:
            lines = [line.removeprefix("FOUND ") for line in run.stdout.splitlines() if line.startswith("FOUND ")]
            assert lines, run.stdout[-1000:] + run.stderr[-2000:]
            return json.loads(lines[0])
    pytest.skip(f"{reader} is not installed")


@pytest.mark.parametrize(("reader", "suffix"), [(name, suffix) for name, of in READERS.items() for suffix in of])
def test_everything_arrives(reader, suffix, dressed, files):
    if suffix not in files:
        pytest.skip("neither bpy nor Blender is installed, which write FBX")
    found = read(reader, files[suffix])
    sys.stdout.write(f"| {reader} | {suffix} | {' | '.join(map(str, found.values()))} |\n")
    template = in_vrm_pose(dressed) if suffix == ".vrm" else dressed
    size = np.ptp(template.vertices, axis=0)
    assert abs(found["height"] - size[1]) < 1e-5 and abs(found["soles"]) < 1e-5
    assert found["wide"] == pytest.approx(size[0] / size[2], rel=1e-4)
    # OBJ has groups, which some readers keep as one mesh.
    meshes = {1, 2} if suffix == ".obj" else {2}
    assert {found["meshes"], found["uv"]} <= meshes and found["meshes"] == found["uv"]
    assert found["normals"] > 0.97, "normals point outwards"
    assert found["pictures"] or (reader, suffix) == ("three", ".obj"), "MTL is another loader of three.js"
    if suffix != ".obj":
        assert found["bones"] in (55, None)
        # VRM has presets beside ARKit's; Blender drops the tongue's from USD, which moves nothing outside of the mouth.
        assert found["morphs"] in {".vrm": (65, None), ".usdc": (51, 52), ".usdz": (51, 52)}.get(suffix, (52, None))


@pytest.mark.parametrize(("name", "suffix"), [(name, suffix) for name, of in VALIDATORS.items() for suffix in of])
def test_validators_have_no_remark(name, suffix, files):
    if name != "khronos":
        assert read(name, files[suffix])["remarks"] == []
        return
    issues = validate(files[suffix])["issues"]
    # It knows no extension of VRM's, and says so.
    assert {issue["code"] for issue in issues["messages"]} <= {"UNSUPPORTED_EXTENSION"}
    assert not issues["numErrors"] and not issues["numWarnings"]
