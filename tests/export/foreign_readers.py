"""What other programs' readers find in a rigged file: a line of JSON; in a Python of its own, without this package.

    python tests/export/foreign_readers.py READER FILE

READER is assimp (assimp_py), ufbx, bpy, usd (usd-core) or trimesh, or a validator, which tells its remarks: usd-rules,
vrm-schema (jsonschema) or vrm-addon (bpy-vrm-format). Exit 3: it is not installed. `load_three.mjs` reads with the
loaders of three.js.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np

Surfaces = list[tuple[np.ndarray, np.ndarray, np.ndarray]]


def told(surfaces: Surfaces, *, bones: int | None, morphs: int | None, uv: int | None, pictures: int | None) -> dict:
    """Return the findings.

    Args:
        surfaces: points, triangles, and normals of the points or of the corners of a mesh each, metres, +Y up.
        bones: that move vertices; None: the reader has none.
        morphs: of the mesh with the most.
        uv: meshes with texture coordinates.
        pictures: of the file or beside it that could be decoded.
    """
    points = np.concatenate([p for p, _, _ in surfaces])
    agree = []
    for p, faces, normals in surfaces:
        flat = np.cross(p[faces[:, 1]] - p[faces[:, 0]], p[faces[:, 2]] - p[faces[:, 0]])
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-20)
        if len(normals):
            corners = normals[faces] if len(normals) == len(p) else normals.reshape(-1, 3, 3)
            agree.append((np.einsum("fkd,fd->fk", corners, flat) > 0).mean())
    return {
        "meshes": len(surfaces),
        "bones": bones,
        "morphs": morphs,
        "uv": uv,
        "pictures": pictures,
        "height": float(np.ptp(points[:, 1])),
        "soles": float(points[:, 1].min()),
        # Width over depth tells x from z, and toes ahead of the heels tell front from back.
        "wide": float(np.ptp(points[:, 0]) / np.ptp(points[:, 2])),
        "normals": float(np.mean(agree)) if agree else None,
    }


def by_assimp(path: Path) -> dict:
    """Read any format but USD with assimp, whose package tells of neither bones nor morphs; FBX's unit is applied."""
    import assimp_py

    scene = assimp_py.import_file(str(path), assimp_py.Process_Triangulate | assimp_py.Process_GlobalScale)
    surfaces, uv = [], 0
    for mesh in scene.meshes:
        points = np.array(mesh.vertices, float).reshape(-1, 3)
        normals = np.zeros((0, 3)) if mesh.normals is None else np.array(mesh.normals, float).reshape(-1, 3)
        surfaces.append((points, np.array(mesh.indices, int).reshape(-1, 3), normals))
        uv += int(bool(mesh.texcoords))
    named = {name for m in scene.materials for names in m.get("TEXTURES", {}).values() for name in names}
    return told(surfaces, bones=None, morphs=None, uv=uv, pictures=len(named))


def by_ufbx(path: Path) -> dict:
    """Read FBX with ufbx."""
    import ufbx

    scene = ufbx.load_file(str(path), target_axes=ufbx.axes_right_handed_y_up, target_unit_meters=1.0)
    surfaces, bones, morphs, uv = [], 0, 0, 0
    for mesh in scene.meshes:
        place = mesh.instances[0].geometry_to_world
        columns = [[getattr(getattr(place, f"c{k}"), axis) for axis in "xyz"] for k in range(4)]
        matrix, shift = np.array(columns[:3]).T, np.array(columns[3])
        points = np.array([(p.x, p.y, p.z) for p in mesh.vertex_position.values]) @ matrix.T + shift
        values = np.array([(n.x, n.y, n.z) for n in mesh.vertex_normal.values]) @ matrix.T
        faces = np.array(list(mesh.vertex_position.indices)).reshape(-1, 3)
        surfaces.append((points, faces, values[np.array(list(mesh.vertex_normal.indices))]))
        bones = max(bones, sum(len(one.clusters) for one in mesh.skin_deformers))
        morphs = max(morphs, sum(len(one.channels) for one in mesh.blend_deformers))
        uv += int(len(mesh.uv_sets) > 0)
    return told(surfaces, bones=bones, morphs=morphs, uv=uv, pictures=len(scene.texture_files))


def by_bpy(path: Path) -> dict:
    """Read GLB, FBX, USD or OBJ with Blender's importers, whose z is up."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    read = {
        ".fbx": lambda: bpy.ops.import_scene.fbx(filepath=str(path)),
        ".obj": lambda: bpy.ops.wm.obj_import(filepath=str(path)),
        ".glb": lambda: bpy.ops.import_scene.gltf(filepath=str(path)),
        ".vrm": lambda: bpy.ops.import_scene.gltf(filepath=str(path)),
    }
    read.get(path.suffix, lambda: bpy.ops.wm.usd_import(filepath=str(path)))()
    surfaces, morphs, uv = [], 0, 0
    # Blender draws bones of a GLB as a ball that is an object, too.
    shown = [thing for thing in bpy.data.objects if "glTF_not_exported" not in {c.name for c in thing.users_collection}]
    worn = [thing for thing in shown if thing.type == "MESH"]
    used = set()
    for thing in worn:
        mesh = thing.data
        mesh.calc_loop_triangles()
        points = np.empty(3 * len(mesh.vertices))
        mesh.vertices.foreach_get("co", points)
        matrix = np.asarray(thing.matrix_world)
        points = points.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
        faces = np.array([t.vertices[:] for t in mesh.loop_triangles])
        normals = np.array([t.split_normals for t in mesh.loop_triangles]) @ matrix[:3, :3].T
        up = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
        surfaces.append((points @ up.T, faces, (normals @ up.T).reshape(-1, 3)))
        morphs = max(morphs, len(mesh.shape_keys.key_blocks) - 1 if mesh.shape_keys else 0)
        uv += int(bool(mesh.uv_layers))
        used |= {thing.vertex_groups[g.group].name for v in mesh.vertices for g in v.groups if g.weight > 0}
    rigs = [thing for thing in bpy.data.objects if thing.type == "ARMATURE"]
    bones = {bone.name for rig in rigs for bone in rig.data.bones}
    pictures = sum(image.size[0] > 0 for image in bpy.data.images)
    return told(surfaces, bones=len(bones & used), morphs=morphs, uv=uv, pictures=pictures)


def by_usd(path: Path) -> dict:
    """Read USD with OpenUSD's own library."""
    from pxr import Usd, UsdGeom, UsdShade, UsdSkel

    stage = Usd.Stage.Open(str(path))
    scale = UsdGeom.GetStageMetersPerUnit(stage)
    surfaces, bones, morphs, uv, named = [], 0, 0, 0, set()
    for prim in stage.Traverse():
        if prim.IsA(UsdSkel.Skeleton):
            bones = len(UsdSkel.Skeleton(prim).GetJointsAttr().Get())
        if prim.IsA(UsdShade.Shader) and (file := UsdShade.Shader(prim).GetInput("file")):
            named |= {file.Get().resolvedPath}
        if prim.IsA(UsdGeom.Mesh):
            mesh = UsdGeom.Mesh(prim)
            points = scale * np.array(mesh.GetPointsAttr().Get(), float)
            faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
            surfaces.append((points, faces, np.array(mesh.GetNormalsAttr().Get() or np.zeros((0, 3)))))
            uv += int(UsdGeom.PrimvarsAPI(prim).HasPrimvar("st"))
            morphs = max(morphs, len(UsdSkel.BindingAPI(prim).GetBlendShapesAttr().Get() or ()))
    return told(surfaces, bones=bones, morphs=morphs, uv=uv, pictures=len(named - {""}))


def by_trimesh(path: Path) -> dict:
    """Read GLB or OBJ with trimesh, which knows no bones and no expressions."""
    import trimesh

    scene = trimesh.load(path, process=False, **({"file_type": "glb"} if path.suffix == ".vrm" else {}))
    made = scene.dump() if isinstance(scene, trimesh.Scene) else [scene]
    surfaces = [(np.asarray(m.vertices), np.asarray(m.faces), np.asarray(m.vertex_normals)) for m in made]
    painted = [m.visual for m in made if getattr(m.visual, "uv", None) is not None]
    images = [getattr(v.material, "baseColorTexture", None) or getattr(v.material, "image", None) for v in painted]
    return told(
        surfaces, bones=None, morphs=None, uv=len(painted), pictures=len({id(one) for one in images if one is not None})
    )


def by_usd_rules(path: Path) -> dict:
    """Hold USD against OpenUSD's rules, with which `usdchecker` works: its validators, before 26 ComplianceChecker."""
    from pxr import Sdr, Tf, Usd, UsdUtils

    if hasattr(UsdUtils, "ComplianceChecker"):
        try:  # the first question fails where PyPI's wheels lack the definitions of UsdPreviewSurface
            Sdr.Registry().GetShaderNodeByIdentifier("UsdPreviewSurface")
        except Tf.ErrorException as error:
            sys.stderr.write(f"{error}\n")
        checker = UsdUtils.ComplianceChecker(arkit=True)
        checker.CheckCompliance(str(path))
        found = [*checker.GetErrors(), *checker.GetFailedChecks(), *checker.GetWarnings()]
        return {"remarks": [one for one in found if "invalid shader node" not in one]}
    from pxr import UsdValidation

    rules = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(rules).Validate(Usd.Stage.Open(str(path)))
    return {"remarks": [one.GetErrorAsString() for one in found]}


def by_vrm_schema(path: Path) -> dict:
    """Hold VRMC_vrm against its JSON schemas, from github.com/vrm-c/vrm-specification in the folder $VRM_SCHEMAS."""
    from jsonschema import Draft202012Validator
    from referencing import Registry, Resource
    from referencing.jsonschema import DRAFT202012

    if "VRM_SCHEMAS" not in os.environ:
        raise ModuleNotFoundError("$VRM_SCHEMAS names no folder")
    # glTF's own, which the extension's refer to, are Khronos's validator's to check.
    of_gltf = {"glTFProperty": {"type": "object"}, "glTFid": {"type": "integer", "minimum": 0}, "textureInfo": {}}
    schemas = {f"{name}.schema.json": schema for name, schema in of_gltf.items()}
    schemas |= {p.name: json.loads(p.read_text()) for p in Path(os.environ["VRM_SCHEMAS"]).rglob("VRMC_vrm*.json")}
    resources = [(name, Resource.from_contents(one, DRAFT202012)) for name, one in schemas.items()]
    data = path.read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    whole = Draft202012Validator(schemas["VRMC_vrm.schema.json"], registry=Registry().with_resources(resources))
    return {"remarks": [one.message for one in whole.iter_errors(document["extensions"]["VRMC_vrm"])]}


def by_vrm_addon(path: Path) -> dict:
    """Hold a VRM against the validator of Blender's VRM add-on (PyPI `bpy-vrm-format`, `io_scene_vrm`), as it opens it.

    Beside its remarks: how many of a human's bones it found.
    """
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    import addon_utils
    import io_scene_vrm.editor.validation as of_addon

    addon_utils.enable("io_scene_vrm", default_set=True)
    bpy.ops.import_scene.vrm(filepath=str(path))
    (rig,) = (thing for thing in bpy.data.objects if thing.type == "ARMATURE")

    class Remarks(list):  # what its operator would fill, a Blender collection
        def add(self) -> SimpleNamespace:
            self.append(SimpleNamespace(message="", severity=0))
            return self[-1]

    remarks = Remarks()
    of_addon.WM_OT_vrm_validator.detect_errors(bpy.context, remarks, rig.name, execute_migration=True)
    bones = rig.data.vrm_addon_extension.vrm1.humanoid.human_bones.human_bone_name_to_human_bone().values()
    found = sum(bool(bone.node.bone_name) for bone in bones)
    return {"remarks": [one.message for one in remarks] + ([] if found == 55 else [f"{found} of 55 bones"])}


READERS: dict[str, Callable[[Path], dict]] = {
    "assimp": by_assimp,
    "ufbx": by_ufbx,
    "bpy": by_bpy,
    "usd": by_usd,
    "trimesh": by_trimesh,
    "usd-rules": by_usd_rules,
    "vrm-schema": by_vrm_schema,
    "vrm-addon": by_vrm_addon,
}

if __name__ == "__main__":
    try:
        sys.stdout.write("FOUND " + json.dumps(READERS[sys.argv[1]](Path(sys.argv[2]))) + "\n")
        sys.stdout.flush()
        os._exit(0)  # ufbx 0.0.5 crashes when its scene is freed
    except ModuleNotFoundError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(3)
