"""A template as FBX, by Blender's own exporter in a process of its own.

Blender and its module bpy are under the GPL: nothing of this package imports them or needs them for anything else.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

from smplxpp.core import DEFAULT_FPS, BodyParams, InputError, require_positive
from smplxpp.core.files.atomic import atomic_path
from smplxpp.export.gltf import write_glb
from smplxpp.template.template import Template

VARIABLE = "BLENDER"
"""Environment variable that names Blender, or a Python with bpy."""
UNITS_A_METRE = 100.0
"""FBX counts in centimetres: with a unit scale of 1 neither Unity nor Unreal scales what it reads."""
ROOT = "Armature"
"""Name of the skeleton's node; of this name Unreal makes no bone of it."""
_REMEDY = (
    "install Blender (blender.org) or `pip install bpy` (its version fits one version of Python), or name either by "
    f"--blender PATH or the variable {VARIABLE}; a .glb opens in Blender, Unity and Unreal without it"
)
# Runs inside Blender. The file's data is turned to +Y up and its objects back to Blender's +Z, which the exporter's own
# turn to +Y cancels: no object of the FBX is turned or scaled, as engines like it.
_SCRIPT = """
import json, math, os, sys
import bpy
from mathutils import Matrix

given = json.loads(sys.argv[-1])
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
# Before the import, which turns seconds into frames and metres into the scene's units.
scene.render.fps = max(1, round(given["fps"]))
scene.render.fps_base = scene.render.fps / given["fps"]
scene.unit_settings.scale_length = 1.0 / given["units"]
bpy.ops.import_scene.gltf(filepath=given["glb"], bone_heuristic="BLENDER")
(rig,) = [thing for thing in bpy.data.objects if thing.type == "ARMATURE"]
worn = [thing for thing in bpy.data.objects if thing.type == "MESH" and thing.find_armature() == rig]
for thing in [one for one in bpy.data.objects if one != rig and one not in worn]:
    bpy.data.objects.remove(thing)
up = Matrix.Rotation(math.radians(-90.0), 4, "X")
for thing in worn:
    thing.data.transform(up, shape_keys=True)
rig.data.transform(up)
rig.matrix_world = up.inverted() @ rig.matrix_world
rig.name = rig.data.name = given["root"]
# Pictures get names with a suffix, which engines that unpack them need, and keep their bytes.
for k, picture in enumerate([one for one in bpy.data.images if one.packed_file]):
    stem, suffix = os.path.splitext(given["fbx"])[0], {"JPEG": "jpg"}.get(picture.file_format, "png")
    picture.name = f"{os.path.basename(stem)}_{k}"
    with open(f"{stem}_{k}.{suffix}", "wb") as file:
        file.write(picture.packed_file.data)
    picture.filepath = f"{stem}_{k}.{suffix}"
    picture.unpack(method="REMOVE")
scene.frame_start, scene.frame_end = 0, max(0, given["frames"] - 1)
bpy.ops.export_scene.fbx(
    filepath=given["fbx"], object_types={"ARMATURE", "MESH"}, axis_forward="-Z", axis_up="Y", add_leaf_bones=False,
    mesh_smooth_type="OFF", colors_type="SRGB", path_mode="COPY", embed_textures=True, bake_anim=given["frames"] > 0,
    bake_anim_use_all_bones=True, bake_anim_use_nla_strips=False, bake_anim_use_all_actions=False,
    bake_anim_simplify_factor=0.0,
)
"""


def blender_command(program: str | Path | None = None) -> list[str]:
    """Return the command that runs a script in Blender, or in a Python that has bpy; the script comes next.

    Looked for in this order: the program given, that of the variable `BLENDER`, `blender` on the path, bpy in this
    interpreter.

    Args:
        program: Blender, or a Python (a name that begins with "python") with bpy.

    Raises:
        InputError: none of them is there.
    """
    named = program or os.environ.get(VARIABLE)
    subject = "option blender" if program else f"variable {VARIABLE}"
    if named:
        found = shutil.which(named)
        if found is None:
            raise InputError(subject, expected="a program", received=f"{named}, which is none", remedy=_REMEDY)
    else:
        found = shutil.which("blender")
        if found is None and find_spec("bpy") is not None:
            found = sys.executable
    if found is None:
        raise InputError("writing FBX", expected="Blender or bpy", received="neither on the path", remedy=_REMEDY)
    # Not resolved: a virtual environment's Python is a link.
    command = str(Path(found).absolute())
    if Path(found).name.lower().startswith("python"):
        return [command]
    return [command, "--background", "--factory-startup", "--python-exit-code", "1", "--python"]


def write_fbx(
    path: str | Path,
    template: Template,
    *,
    animation: BodyParams | None = None,
    root: str = ROOT,
    blender: str | Path | None = None,
) -> None:
    """Write the template as a binary FBX, whole or not at all: skeleton, weights, expressions, colours, motion.

    Centimetres with a unit scale of 1, +Y up, facing +Z; no object is turned or scaled, and at rest no bone either.
    The first frame of a motion is frame 0. A vertex keeps its 8 strongest joints.

    Args:
        path: of the file.
        template: body and parts in the T-pose.
        animation: T frames, played at their `fps` or `DEFAULT_FPS`.
        root: name of the skeleton's node, which Unreal takes for the root bone unless it is "Armature".
        blender: Blender or a Python with bpy; None: as `blender_command` finds it.

    Raises:
        InputError: no Blender, one that fails, or an animation that the template cannot play.
    """
    command = blender_command(blender)
    fps = DEFAULT_FPS if animation is None else animation.fps or DEFAULT_FPS
    require_positive("frames a second of the animation", fps)
    # Seconds that Blender may take, for a motion of many thousand frames on a slow machine.
    timeout = 1800
    with tempfile.TemporaryDirectory() as folder, atomic_path(path) as written:
        # The file says where it was first written: under its own name, not the temporary one beside the target.
        glb, script, fbx = Path(folder) / "template.glb", Path(folder) / "to_fbx.py", Path(folder) / Path(path).name
        write_glb(glb, template, animation=animation)
        script.write_text(_SCRIPT)
        asked = {
            "glb": str(glb),
            "fbx": str(fbx),
            "fps": fps,
            "frames": 0 if animation is None else len(animation),
            "units": UNITS_A_METRE,
            "root": root,
        }
        line = [*command, str(script), "--", json.dumps(asked)]
        try:
            done = subprocess.run(
                line, capture_output=True, text=True, errors="replace", timeout=timeout, check=False, cwd=folder
            )
        except subprocess.TimeoutExpired:
            raise InputError(command[0], expected=f"an end within {timeout} s", received="none") from None
        if done.returncode or not fbx.is_file():
            last_line = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
            raise InputError(
                f"{command[0]} on the rigged GLB",
                expected="an FBX",
                received=f"exit status {done.returncode}: {last_line}"[:600],
                remedy="Blender 4.2 and later and bpy 5.0 are known to work; a Python needs bpy",
            )
        shutil.copyfile(fbx, written)
