"""A template's GLB or FBX into Blender, looked at, and out again as .blend or an .obj of one frame.

    blender --background --python examples/blender/convert.py -- me.glb --out me.blend --fps 20
    python examples/blender/convert.py me.glb --out me.blend --fps 20       # with PyPI's bpy (Python 3.11: bpy 5.0)

Blender and bpy are under the GPL: this package neither needs nor imports them; this script does, a program of its own.
"""

import argparse
import json
import sys
from pathlib import Path

import bpy

# Blender's own axes are z up; OBJ keeps y up on the way out.
AXES = {"forward_axis": "NEGATIVE_Z", "up_axis": "Y"}


def main() -> None:
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "source", type=Path, help="what `smplxpp export RUN --out me.glb --model template` wrote, or .fbx"
    )
    parser.add_argument("--out", type=Path, required=True, help=".blend or .obj")
    parser.add_argument("--fps", type=int, default=20, help="frames a second of the motion: one frame of Blender each")
    parser.add_argument("--frame", type=int, default=0, help="of an .obj")
    options = parser.parse_args(given)

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = options.fps  # before the import, which turns seconds into frames
    read = bpy.ops.import_scene.fbx if options.source.suffix == ".fbx" else bpy.ops.import_scene.gltf
    read(filepath=str(options.source))

    rigs = [thing for thing in bpy.data.objects if thing.type == "ARMATURE"]
    worn = [thing for thing in bpy.data.objects if thing.type == "MESH" and thing.find_armature()]
    if len(rigs) != 1 or not worn:
        raise SystemExit(f"expected one armature that moves meshes, found {len(rigs)} and {len(worn)}")
    keys = {thing.name: len(thing.data.shape_keys.key_blocks) - 1 for thing in worn if thing.data.shape_keys}
    times = [time for action in bpy.data.actions for time in action.frame_range] or [0]
    scene.frame_start, scene.frame_end = int(min(times)), int(max(times))
    found = {"bones": len(rigs[0].data.bones), "meshes": sorted(thing.name for thing in worn), "shape_keys": keys}
    print(json.dumps(found | {"frames": [scene.frame_start, scene.frame_end]}))

    if options.out.suffix == ".blend":
        bpy.ops.wm.save_as_mainfile(filepath=str(options.out.resolve()))
    else:
        scene.frame_set(options.frame)
        for thing in bpy.data.objects:
            thing.select_set(thing in worn)
        bpy.ops.wm.obj_export(filepath=str(options.out), export_selected_objects=True, export_materials=False, **AXES)


if __name__ == "__main__":
    main()
