"""A template, with its skin, expressions and motion, as a binary glTF 2.0 file."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import pygltflib

from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.params import BodyParams
from smplxpp.export.gltf_animation import add_animation
from smplxpp.export.gltf_buffers import BufferBuilder
from smplxpp.export.gltf_mesh import add_parts
from smplxpp.export.gltf_skin import add_skin
from smplxpp.template.template import BODY_PART, Template


def write_glb(
    path: str | Path, template: Template, *, animation: BodyParams | None = None, morph_targets: bool = True
) -> None:
    """Write the template as a GLB file, whole or not at all; the same template gives the same bytes.

    The axes are the template's: metres, +Y up. Each part is a mesh of its own with the material of its label and the
    scan's colours; one skin moves all. A vertex keeps its 8 strongest joints in two sets (`JOINTS_0` the four
    strongest), exactly normalised. With at most 8 joints a vertex, no pose correctives and linear interpolation aside,
    the file's skinning gives what `template.pose(animation)` gives, to float32.

    Args:
        path: of the file, with any suffix; `.glb` is usual.
        template: body and parts in the T-pose.
        animation: T frames, played at their `fps` or `DEFAULT_FPS`.
        morph_targets: write the expressions, sparsely, as morph targets of the body.

    Raises:
        InputError: an animation that the template cannot play: more expressions than it has, a skeleton outside the
            SMPL family, no frames, a frame rate that is not positive.

    Warns:
        GeometryWarning: an animation of a template with pose correctives, which glTF's skinning leaves out.

    Example:
        >>> smplxpp.write_glb("anna.glb", template, animation=params)  # doctest: +SKIP
    """
    gltf = pygltflib.GLTF2(
        asset=pygltflib.Asset(version="2.0", generator=f"smplxpp {metadata.version('smplxpp')}"), scene=0
    )
    buffers = BufferBuilder(gltf)
    joint_nodes = add_skin(gltf, buffers, template)
    part_nodes = add_parts(gltf, buffers, template, morph_targets=morph_targets)
    # Skinned meshes stand at the root of the scene: nodes above them would not move them.
    gltf.scenes = [pygltflib.Scene(name="template", nodes=[int(joint_nodes[0]) - 1, *part_nodes])]
    if animation is not None:
        morph_node = next(
            (n for n in part_nodes if gltf.nodes[n].name == BODY_PART and gltf.meshes[gltf.nodes[n].mesh].weights), None
        )
        add_animation(gltf, buffers, template, animation, joint_nodes=joint_nodes, morph_node=morph_node)
    atomic_write_bytes(path, buffers.glb())
