"""An add-on for Blender: transfer skin weights to garments, check them, and bring a template in with its shape keys.

Install smplxpp into Blender's own Python (`BLENDER/python/bin/python -m pip install .`), then this file by
Edit > Preferences > Add-ons > Install from Disk. The panel is in the sidebar (N) of the 3D view, tab *SMPL-X++*.

Select the garments, then the body, which has an armature and vertex groups; all in the rest pose. From a script:

    bpy.ops.smplxpp.import_template(filepath="runs/me/60_assemble/smplxpp.npz")
    bpy.ops.smplxpp.transfer_weights(label="lower", influences=4)
    bpy.ops.smplxpp.check_garments()
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import bpy
import numpy as np

import smplxpp
from smplxpp.metrics import mesh_quality, penetration, weight_report
from smplxpp.transfer.config import JOINTS_OF_LABEL

bl_info = {
    "name": "SMPL-X++ skin weights",
    "author": "the smplxpp project",
    "version": (0, 1, 0),
    "blender": (4, 2, 0),
    "location": "View3D > Sidebar > SMPL-X++",
    "description": "Transfer skin weights from a body to garments, check them, import a template",
    "category": "Rigging",
}
COLORS = "smplxpp_check"
FINE, INSIDE, UNWEIGHTED = (0.75, 0.75, 0.75, 1.0), (1.0, 0.1, 0.05, 1.0), (1.0, 0.6, 0.0, 1.0)
LABELS = [("any", "Any garment", "All bones may be followed"), *((n, n.title(), f"As {n}") for n in JOINTS_OF_LABEL)]


def world_mesh(thing: bpy.types.Object) -> smplxpp.TriangleMesh:
    """The rest mesh of an object in world coordinates, triangulated as Blender draws it; vertices in their order."""
    data = thing.data
    points = np.empty(3 * len(data.vertices), np.float32)
    data.vertices.foreach_get("co", points)
    data.calc_loop_triangles()
    faces = np.empty(3 * len(data.loop_triangles), np.int32)
    data.loop_triangles.foreach_get("vertices", faces)
    matrix = np.array(thing.matrix_world)
    vertices = points.reshape(-1, 3).astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    # A mirrored object shows its faces the other way round.
    corners = faces.reshape(-1, 3)
    return smplxpp.TriangleMesh(vertices, corners if np.linalg.det(matrix[:3, :3]) > 0 else corners[:, ::-1])


def joint_weights(thing: bpy.types.Object, names: list[str]) -> np.ndarray:
    """The vertex groups of these names as weights (N, J), rows that have any summing to 1."""
    column = {group.index: names.index(group.name) for group in thing.vertex_groups if group.name in names}
    out = np.zeros((len(thing.data.vertices), len(names)))
    for vertex in thing.data.vertices:
        for found in vertex.groups:
            if found.group in column:
                out[vertex.index, column[found.group]] = found.weight
    total = out.sum(axis=1, keepdims=True)
    return np.divide(out, total, out=out, where=total > 0)


def write_weights(thing: bpy.types.Object, names: list[str], weights: smplxpp.SkinWeights) -> None:
    """Replace the vertex groups of these names; groups of other names, such as for simulation, stay."""
    for group in [group for group in thing.vertex_groups if group.name in names]:
        thing.vertex_groups.remove(group)
    sparse = weights.to_sparse().tocsc()
    for joint in np.flatnonzero(np.diff(sparse.indptr)):
        group = thing.vertex_groups.new(name=names[joint])
        start, end = sparse.indptr[joint : joint + 2]
        for vertex, weight in zip(sparse.indices[start:end].tolist(), sparse.data[start:end].tolist(), strict=True):
            group.add([vertex], weight, "REPLACE")


def body_and_garments(context: bpy.types.Context) -> tuple[bpy.types.Object, bpy.types.Object, list[bpy.types.Object]]:
    """The active body, its armature, and the other selected meshes."""
    body = context.view_layer.objects.active
    rig = body.find_armature() if body is not None and body.type == "MESH" else None
    if rig is None:
        raise smplxpp.InputError(
            "active object", expected="a body with an armature", received=getattr(body, "name", "none")
        )
    garments = [thing for thing in context.selected_objects if thing.type == "MESH" and thing is not body]
    if not garments:
        raise smplxpp.InputError("selection", expected="garments beside the active body", received="none")
    return body, rig, garments


def bones_of(body: bpy.types.Object, rig: bpy.types.Object) -> list[str]:
    """The bones that move the body, in the order of its vertex groups."""
    return [g.name for g in body.vertex_groups if g.name in rig.data.bones and rig.data.bones[g.name].use_deform]


class Operator(bpy.types.Operator):
    """What can be wrong with an input is reported in Blender's status bar."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012  Blender reads it as it is

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            self.run(context)
        except (smplxpp.InputError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class SMPLXPP_OT_transfer_weights(Operator):
    """Give the selected garments the active body's skin weights, and bind them to its armature"""

    bl_idname = "smplxpp.transfer_weights"
    bl_label = "Transfer skin weights"

    label: bpy.props.EnumProperty(name="Garment", items=LABELS, default="any")
    influences: bpy.props.IntProperty(name="Bones a vertex", default=4, min=1, max=16)

    def run(self, context: bpy.types.Context) -> None:
        body, rig, garments = body_and_garments(context)
        names = bones_of(body, rig)
        base = smplxpp.TransferConfig(max_influences=self.influences, joint_names=tuple(names))
        config = base
        if self.label != "any":
            config = smplxpp.TransferConfig.for_label(self.label, base=base)
            if not set(config.allowed_joints or ()) <= set(names):
                self.report({"WARNING"}, "the bones have other names than SMPL-X's: every bone may be followed")
                config = base
        source, weights = world_mesh(body), joint_weights(body, names)
        for thing in garments:
            found = smplxpp.transfer_weights(source, weights, world_mesh(thing), config=config)
            write_weights(thing, names, found)
            if not any(modifier.type == "ARMATURE" for modifier in thing.modifiers):
                thing.modifiers.new("Armature", "ARMATURE").object = rig
            self.report({"INFO"}, f"{thing.name}: {found}, {found.matched.mean():.0%} matched")


class SMPLXPP_OT_check_garments(Operator):
    """Check weights, surface and penetration of the selected garments; faults are coloured in smplxpp_check"""

    bl_idname = "smplxpp.check_garments"
    bl_label = "Check garments"

    def run(self, context: bpy.types.Context) -> None:
        body, rig, garments = body_and_garments(context)
        names = bones_of(body, rig)
        for thing in garments:
            mesh, weights = world_mesh(thing), joint_weights(thing, names)
            quality, report = mesh_quality(mesh), weight_report(weights)
            inside = penetration(mesh, world_mesh(body)).penetrating
            empty = weights.sum(axis=1) == 0
            color = np.where(empty[:, None], UNWEIGHTED, np.where(inside[:, None], INSIDE, FINE)).astype(np.float32)
            old = thing.data.color_attributes.get(COLORS)
            if old is not None:
                thing.data.color_attributes.remove(old)
            thing.data.color_attributes.new(COLORS, "FLOAT_COLOR", "POINT").data.foreach_set("color", color.ravel())
            faults = {
                "vertices without weights": report.zero_rows,
                "vertices inside the body": int(inside.sum()),
                "edges with three faces": quality.nonmanifold_edges,
                "faces wound the other way": quality.flipped_faces,
            }
            said = ", ".join(f"{count} {fault}" for fault, count in faults.items() if count)
            self.report({"WARNING" if said else "INFO"}, f"{thing.name}: {said or 'nothing wrong'}")


class SMPLXPP_OT_import_template(Operator):
    """Import a template (smplxpp.npz of a run, or its .glb): armature, body, parts, expressions as shape keys"""

    bl_idname = "smplxpp.import_template"
    bl_label = "Import template"

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def run(self, context: bpy.types.Context) -> None:
        path = Path(self.filepath)
        with tempfile.TemporaryDirectory() as folder:
            if path.suffix.lower() != ".glb":
                template = smplxpp.Template.load(path)
                path = Path(folder) / "template.glb"
                template.export(path)
            bpy.ops.import_scene.gltf(filepath=str(path))


class SMPLXPP_PT_panel(bpy.types.Panel):
    bl_label = "SMPL-X++"
    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "SMPL-X++"

    def draw(self, context: bpy.types.Context) -> None:
        for kind in OPERATORS:
            self.layout.operator(kind.bl_idname)


OPERATORS = (SMPLXPP_OT_import_template, SMPLXPP_OT_transfer_weights, SMPLXPP_OT_check_garments)


def register() -> None:
    for kind in (*OPERATORS, SMPLXPP_PT_panel):
        bpy.utils.register_class(kind)


def unregister() -> None:
    for kind in (SMPLXPP_PT_panel, *reversed(OPERATORS)):
        bpy.utils.unregister_class(kind)


if __name__ == "__main__":
    register()
