"""Blender opens the rigged GLB: armature, shape keys, motion; and writes it as FBX. Skips without Blender."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from smplxpp.core import InputError
from smplxpp.export import write_glb
from smplxpp.export.fbx import VARIABLE, blender_command, write_fbx
from tests.export.templates import open_body_template, random_motion, random_template

SCRIPT = Path(__file__).resolve().parents[2] / "examples" / "blender" / "convert.py"


def blender(*arguments: object) -> dict:
    """Run the example by bpy or by Blender; what it found."""
    try:
        command = blender_command()
    except InputError:
        pytest.skip("neither bpy nor Blender is installed")
    line = [*command, str(SCRIPT), "--", *map(str, arguments)]
    run = subprocess.run(line, capture_output=True, text=True, timeout=900, check=True)
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
    # The same by the command's own FBX, with another program's names; Blender counts its frames from 1.
    template.export(tmp_path / "a.fbx", animation=motion, joint_names="unreal")
    again = blender(tmp_path / "a.fbx", "--out", tmp_path / "b.obj", "--frame", 3)
    assert (again["bones"], again["shape_keys"]) == (55, {"body": 52})
    mesh = trimesh.load(tmp_path / "b.obj", process=False, force="mesh")
    np.testing.assert_allclose(mesh.vertices, ours, atol=2e-5)
    # Unit and axes as the file states them: centimetres, +Y up, +Z front; no object is turned or scaled.
    data = (tmp_path / "a.fbx").read_bytes()
    assert stated(data, b"UnitScaleFactor") == 1.0
    assert b"upperarm_l" in data and b"left_shoulder" not in data and b"root" in data


def stated(data: bytes, name: bytes) -> float:
    """The number of a property of a binary FBX: `D` and 8 bytes after its name and three texts."""
    found = re.search(re.escape(name) + rb"S.{4}doubleS.{4}NumberS.{4}D(.{8})", data, re.DOTALL)
    assert found is not None
    return float(np.frombuffer(found[1], "<f8")[0])


def test_without_blender_an_error_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr("smplxpp.export.fbx.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"expected Blender or bpy.*pip install bpy"):
        random_template().export(tmp_path / "a.fbx")
    monkeypatch.setenv(VARIABLE, "no-such-blender")
    with pytest.raises(InputError, match="variable BLENDER: expected a program, received no-such-blender"):
        blender_command()
    with pytest.raises(InputError, match="option blender: expected a program"):
        random_template().export(tmp_path / "a.fbx", blender="other")
    with pytest.raises(InputError, match=r"option blender: expected a file \.fbx, received \.glb"):
        random_template().export(tmp_path / "a.glb", blender="other")
    assert list(tmp_path.iterdir()) == []


def test_a_program_that_fails_is_quoted_and_leaves_no_file(tmp_path):
    program = tmp_path / "blender"
    program.write_text("#!/bin/sh\necho no display >&2\nexit 3\n")
    program.chmod(0o755)
    with pytest.raises(InputError, match="expected an FBX, received exit status 3: no display"):
        write_fbx(tmp_path / "a.fbx", random_template(), blender=program)
    assert list(tmp_path.iterdir()) == [program]


ADDON = SCRIPT.with_name("transfer_addon.py")
SESSION = """
import sys, json, bpy, mathutils, numpy as np
sys.path[:0] = [{root!r}, {folder!r}]
import transfer_addon as addon
bpy.ops.wm.read_factory_settings(use_empty=True)
addon.register()
bpy.ops.smplxpp.import_template(filepath={template!r})
body = bpy.data.objects["body"]
rig = body.find_armature()
names = addon.bones_of(body, rig)
mesh = addon.world_mesh(body)
# A shirt: the trunk's faces, 2 cm off the skin and turned and moved as an object of its own.
faces = np.array({faces})
used, local = np.unique(faces, return_inverse=True)
points = mesh.vertices[used] + 0.02 * mesh.vertex_normals[used]
data = bpy.data.meshes.new("shirt")
data.from_pydata(((points - [1, 2, 3])[:, [1, 2, 0]]).tolist(), [], local.reshape(faces.shape).tolist())
shirt = bpy.data.objects.new("shirt", data)
bpy.context.collection.objects.link(shirt)
shirt.matrix_world = mathutils.Matrix([[0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]])
bpy.context.view_layer.update()
shirt.vertex_groups.new(name="pin").add([0], 1.0, "REPLACE")
for thing in bpy.context.selected_objects:
    thing.select_set(False)
shirt.select_set(True)
body.select_set(True)
bpy.context.view_layer.objects.active = body
done = [bpy.ops.smplxpp.transfer_weights(label="upper", influences=4), bpy.ops.smplxpp.check_garments()]
found = addon.joint_weights(shirt, names)
truth = addon.smplxpp.transfer_weights(mesh, addon.joint_weights(body, names), addon.world_mesh(shirt),
    config=addon.smplxpp.TransferConfig.for_label("upper", base=addon.smplxpp.TransferConfig(max_influences=4)))
colors = np.empty(4 * len(used), np.float32)
data.color_attributes[addon.COLORS].data.foreach_get("color", colors)
shirt.matrix_world = mathutils.Matrix.Translation((0, 0.06, 0)) @ shirt.matrix_world
bpy.context.view_layer.update()
bpy.ops.smplxpp.check_garments()
inside = np.empty(4 * len(used), np.float32)
data.color_attributes[addon.COLORS].data.foreach_get("color", inside)
shirt.matrix_world = mathutils.Matrix.Translation((0, -0.06, 0)) @ shirt.matrix_world
# In a pose Blender moves the shirt by these weights.
bone = rig.pose.bones["left_shoulder"]
bone.rotation_mode = "XYZ"
bone.rotation_euler = (0.0, 0.0, 0.7)
bpy.context.view_layer.update()
posed = shirt.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
moved = max((a.co - b.co).length for a, b in zip(posed.vertices, data.vertices))
shirt.select_set(False)
try:
    bpy.ops.smplxpp.transfer_weights()
    refused = ""
except RuntimeError as error:
    refused = str(error)
print("ADDON " + json.dumps(dict(
    done=[list(d) for d in done], names=names, groups=[g.name for g in shirt.vertex_groups][:1],
    placed=float(np.abs(addon.world_mesh(shirt).vertices - points).max()),
    error=float(np.abs(found - truth.dense()).max()), most=int((found > 0).sum(axis=1).max()),
    red=[int((c.reshape(-1, 4)[:, 1] < 0.2).sum()) for c in (colors, inside)], moved=moved, refused=refused,
    keys=len(body.data.shape_keys.key_blocks) - 1)))
"""


def test_the_add_on_transfers_checks_and_imports(tmp_path):
    pytest.importorskip("bpy")
    template = open_body_template()
    template.save(tmp_path / "smplxpp.npz")
    names = template.body.joint_names
    trunk = [names.index(name) for name in ("spine1", "spine2", "spine3", "left_collar", "left_shoulder")]
    held = template.weights.dense()[:, trunk].sum(axis=1) > 0.6
    faces = template.faces[held[template.faces].all(axis=1)].tolist()
    root, folder = str(ADDON.parents[2]), str(ADDON.parent)
    script = SESSION.format(root=root, folder=folder, template=str(tmp_path / "smplxpp.npz"), faces=faces)
    (tmp_path / "session.py").write_text(script)
    run = subprocess.run(
        [sys.executable, str(tmp_path / "session.py")], capture_output=True, text=True, timeout=900, check=False
    )
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-2000:]
    found = json.loads(next(line[6:] for line in run.stdout.splitlines() if line.startswith("ADDON ")))
    assert found["done"] == [["FINISHED"], ["FINISHED"]] and found["groups"] == ["pin"]
    assert set(found["names"]) == set(names) and found["keys"] == template.body.exprdirs.shape[-1]
    assert found["placed"] < 1e-6 and found["error"] < 1e-6 and found["most"] <= 4
    assert found["red"][0] == 0 < found["red"][1] and found["moved"] > 0.05
    assert "garments beside the active body" in found["refused"]
