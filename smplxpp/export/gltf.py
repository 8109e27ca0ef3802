"""A template, with its skin, expressions and motion, as a binary glTF 2.0 file."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

import numpy as np
import pygltflib
from jaxtyping import Float64, Int, UInt8, UInt16
from pygltflib import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER

from smplxpp.core.colors import decode_srgb
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.params import BodyParams
from smplxpp.export.gltf_animation import add_animation
from smplxpp.export.gltf_buffers import BufferBuilder, index_dtype
from smplxpp.export.gltf_skin import add_skin, influence_sets, quantized_influences
from smplxpp.template.template import BODY_PART, Template
from smplxpp.template.texture import Texture, part_surface

MorphTargets = Mapping[str, Float64[np.ndarray, "V 3"]]
"""Displacements of a template's vertices by name, metres."""


def add_parts(
    gltf: pygltflib.GLTF2,
    buffers: BufferBuilder,
    template: Template,
    *,
    morph_targets: bool,
    shapes: MorphTargets | None = None,
) -> list[int]:
    """Add a mesh, a material and a node for every part that has faces; skin 0 moves them all.

    Vertices of a part keep their order, the body's being the body model's own; where a texture's seams split them,
    the copies follow.

    Returns:
        Indices of the nodes, the body's first.
    """
    # Weights are rounded so that rows sum to exactly one. Colours are linear, as COLOR_0 of glTF is, not sRGB.
    joints, weights = quantized_influences(template.weights)
    normals = _unit_normals(template)
    colors = linear_rgba16(template.vertex_colors)
    pictures = add_pictures(buffers, template.texture)
    nodes = []
    for index, name in enumerate(template.part_names):
        surface = part_surface(template, index)
        if surface is None:
            continue
        rows = surface.rows
        attributes = {
            "POSITION": buffers.add(template.vertices[rows].astype(np.float32), target=ARRAY_BUFFER, bounds=True),
            "NORMAL": buffers.add(normals[rows], target=ARRAY_BUFFER),
        }
        if surface.uv is None:
            attributes["COLOR_0"] = buffers.add(colors[rows], target=ARRAY_BUFFER, normalized=True)
        else:
            # Viewers multiply COLOR_0 by the texture, so that a part has one or the other.
            attributes["TEXCOORD_0"] = buffers.add(surface.uv.astype(np.float32), target=ARRAY_BUFFER)
        if surface.tangents is not None:
            attributes["TANGENT"] = buffers.add(surface.tangents.astype(np.float32), target=ARRAY_BUFFER)
        # glTF holds four influences a set, so that more of them need further sets.
        for k, (set_joints, set_weights) in enumerate(influence_sets(joints[rows], weights[rows])):
            attributes[f"JOINTS_{k}"] = buffers.add(set_joints, target=ARRAY_BUFFER)
            attributes[f"WEIGHTS_{k}"] = buffers.add(set_weights, target=ARRAY_BUFFER)
        primitive = pygltflib.Primitive(
            attributes=pygltflib.Attributes(**attributes),
            indices=buffers.add(surface.faces.reshape(-1).astype(index_dtype(len(rows))), target=ELEMENT_ARRAY_BUFFER),
            material=len(gltf.materials),
        )
        gltf.materials.append(_material(template, name, rows, pictures.get(index)))
        mesh = pygltflib.Mesh(name=name, primitives=[primitive])
        if morph_targets and name == BODY_PART and template.body.num_expressions:
            _add_expressions(buffers, template, mesh, rows)
        _add_shapes(buffers, mesh, {name: moved[rows] for name, moved in (shapes or {}).items()})
        nodes.append(len(gltf.nodes))
        gltf.nodes.append(pygltflib.Node(name=name, mesh=len(gltf.meshes), skin=0))
        gltf.meshes.append(mesh)
    return nodes


def add_pictures(buffers: BufferBuilder, texture: Texture | None) -> dict[int, tuple[int, int | None]]:
    """Add the pictures of a texture, and return glTF's textures of colours and normals of each part."""
    if texture is None:
        return {}
    made = [
        (
            buffers.add_image(color, "image/jpeg"),
            buffers.add_image(texture.normals[k], "image/png") if texture.normals else None,
        )
        for k, color in enumerate(texture.colors)
    ]
    return {part: made[k] for part, k in enumerate(texture.picture.tolist())}


def linear_rgba16(colors: UInt8[np.ndarray, "N 3"]) -> UInt16[np.ndarray, "N 4"]:
    """Convert sRGB bytes to 16-bit linear RGB with full alpha.

    Vertex colours of glTF are linear; 16 bits keep dark tones apart that 8 would merge.
    """
    table = np.rint(65535 * decode_srgb(np.arange(256) / 255.0)).astype(np.uint16)
    return np.pad(table[colors], ((0, 0), (0, 1)), constant_values=65535)


def _add_expressions(buffers: BufferBuilder, template: Template, mesh: pygltflib.Mesh, rows: np.ndarray) -> None:
    # (E, n, 3): each target's rows lie together.
    offsets = np.ascontiguousarray(np.moveaxis(template.body.exprdirs[rows], 2, 0), dtype=np.float32)
    # A vertex that an expression of one unit moves by less, in metres, is left out of that morph target.
    still = 1e-6
    moved = np.einsum("evc,evc->ev", offsets, offsets) > still**2
    mesh.primitives[0].targets = [
        {"POSITION": buffers.add_sparse(target, np.flatnonzero(rows))}
        for target, rows in zip(offsets, moved, strict=True)
    ]
    mesh.weights = [0.0] * len(offsets)
    mesh.extras = {"targetNames": list(template.body.expression_names)}


def _add_shapes(buffers: BufferBuilder, mesh: pygltflib.Mesh, shapes: MorphTargets) -> None:
    """Add the displacements of a mesh's vertices that are not zero as further morph targets."""
    moving = {name: moved.astype(np.float32) for name, moved in shapes.items() if moved.any()}
    if not moving:
        return
    names = [*(mesh.extras or {}).get("targetNames", ()), *moving]
    mesh.primitives[0].targets = [
        *(mesh.primitives[0].targets or ()),
        *({"POSITION": buffers.add_sparse(moved, np.flatnonzero(moved.any(axis=1)))} for moved in moving.values()),
    ]
    mesh.weights = [0.0] * len(names)
    mesh.extras = {"targetNames": names}


def _unit_normals(template: Template) -> np.ndarray:
    """(V, 3) float32; up where a vertex has no face of any area, since glTF asks for length 1 everywhere."""
    normals = template.mesh.vertex_normals.astype(np.float32)
    normals[~normals.any(axis=1)] = (0.0, 1.0, 0.0)
    return normals


def _material(
    template: Template, name: str, rows: np.ndarray, pictures: tuple[int, int | None] | None
) -> pygltflib.Material:
    label = template.labels[int(np.bincount(template.vertex_labels[rows]).argmax())]
    color, relief = pictures or (None, None)
    return pygltflib.Material(
        name=label.name,
        pbrMetallicRoughness=pygltflib.PbrMetallicRoughness(
            metallicFactor=0.0,
            roughnessFactor=0.9,
            baseColorTexture=None if color is None else pygltflib.TextureInfo(index=color),
        ),
        normalTexture=None if relief is None else pygltflib.NormalMaterialTexture(index=relief),
        # Clothes are open sheets, seen from inside at hems and cuffs; the body is closed.
        doubleSided=name != BODY_PART,
        alphaCutoff=None,
        extras={"label": label.id, "part": name},
    )


def write_glb(
    path: str | Path,
    template: Template,
    *,
    animation: BodyParams | None = None,
    morph_targets: bool = True,
    root: str = "skeleton",
) -> None:
    """Write the template as a GLB file, whole or not at all; the same template gives the same bytes.

    The axes are the template's: metres, +Y up. Each part is a mesh of its own with the material of its label, and the
    template's texture or, without one, the colours of its vertices; one skin moves all. A vertex keeps its 8 strongest
    joints in two sets (`JOINTS_0` the four strongest), exactly normalised. With at most 8 joints a vertex, no pose
    correctives and linear interpolation aside, the file's skinning gives what `template.pose(animation)` gives, to
    float32.

    Args:
        path: of the file, with any suffix; `.glb` is usual.
        template: body and parts in the T-pose.
        animation: T frames, played at their `fps` or `DEFAULT_FPS`.
        morph_targets: write the expressions, sparsely, as morph targets of the body.
        root: name of the skeleton's node at the origin, which Unreal takes for the root bone.

    Raises:
        InputError: an animation that the template cannot play: more expressions than it has, a skeleton outside the
            SMPL family, no frames, a frame rate that is not positive.

    Warns:
        GeometryWarning: an animation of a template with pose correctives, which glTF's skinning leaves out.

    Example:
        >>> smplxpp.write_glb("anna.glb", template, animation=params)  # doctest: +SKIP
    """
    gltf, buffers, joint_nodes, part_nodes = rigged_gltf(template, morph_targets=morph_targets)
    gltf.nodes[gltf.skins[0].skeleton].name = root
    if animation is not None:
        morph_node = next(
            (n for n in part_nodes if gltf.nodes[n].name == BODY_PART and gltf.meshes[gltf.nodes[n].mesh].weights), None
        )
        add_animation(gltf, buffers, template, animation, joint_nodes=joint_nodes, morph_node=morph_node)
    atomic_write_bytes(path, buffers.glb())


def rigged_gltf(
    template: Template, *, morph_targets: bool, shapes: MorphTargets | None = None
) -> tuple[pygltflib.GLTF2, BufferBuilder, Int[np.ndarray, " J"], list[int]]:
    """Return a scene of the template: its document and buffer, the nodes of the joints, and those of the parts.

    Args:
        template: body and parts in the T-pose.
        morph_targets: add the expressions as morph targets of the body.
        shapes: further morph targets, of every part that they move.
    """
    gltf = pygltflib.GLTF2(
        asset=pygltflib.Asset(version="2.0", generator=f"smplxpp {metadata.version('smplxpp')}"), scene=0
    )
    buffers = BufferBuilder(gltf)
    joint_nodes = add_skin(gltf, buffers, template)
    part_nodes = add_parts(gltf, buffers, template, morph_targets=morph_targets, shapes=shapes)
    # Skinned meshes stand at the root of the scene: nodes above them would not move them.
    gltf.scenes = [pygltflib.Scene(name="template", nodes=[int(joint_nodes[0]) - 1, *part_nodes])]
    return gltf, buffers, joint_nodes, part_nodes
