"""Blender opens the rigged GLB: armature, shape keys, motion; and takes it on to FBX. Skips without Blender."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import trimesh

from smplxpp.export import write_glb
from tests.export.templates import open_body_template, random_motion

SCRIPT = Path(__file__).resolve().parents[2] / "examples" / "blender" / "convert.py"


def blender(*arguments: object) -> dict:
    """Run the example by bpy or by Blender; what it found."""
    if find_spec("bpy"):
        command = [sys.executable, str(SCRIPT)]
    elif program := shutil.which("blender"):
        command = [program, "--background", "--python", str(SCRIPT), "--"]
    else:
        pytest.skip("neither bpy nor Blender is installed")
    run = subprocess.run([*command, *map(str, arguments)], capture_output=True, text=True, timeout=900, check=True)
    return json.loads(next(line for line in run.stdout.splitlines() if line.startswith('{"bones"')))


def test_blender_moves_the_template_as_we_do_and_fbx_keeps_it(tmp_path):
    template, motion = open_body_template(), random_motion(4, expressions=52, fps=20.0)
    motion = replace(motion, flat_hand_mean=True)
    template = replace(template, body=replace(template.body, posedirs=None))
    write_glb(tmp_path / "a.glb", template, animation=motion)
    found = blender(tmp_path / "a.glb", "--out", tmp_path / "a.obj", "--frame", 2)
    assert (found["bones"], found["meshes"], found["shape_keys"]) == (55, ["body"], {"body": 52})
    ours = template.pose(motion)[2]
    mesh = trimesh.load(tmp_path / "a.obj", process=False, force="mesh")
    np.testing.assert_allclose(mesh.vertices, ours, atol=2e-5)
    blender(tmp_path / "a.glb", "--out", tmp_path / "a.fbx")
    again = blender(tmp_path / "a.fbx", "--out", tmp_path / "b.obj", "--frame", 3)  # an FBX counts from 1
    assert (again["bones"], again["shape_keys"]) == (55, {"body": 52})
    mesh = trimesh.load(tmp_path / "b.obj", process=False, force="mesh")
    np.testing.assert_allclose(mesh.vertices, ours, atol=2e-5)
