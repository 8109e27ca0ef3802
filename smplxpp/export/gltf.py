"""GLB files: the template as an engine sees it, with skin, expressions, colours and motion."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import numpy as np
import pygltflib as gl

from smplxpp.core.atomic import atomic_write_bytes
from smplxpp.core.errors import InputError
from smplxpp.core.labels import LABELS
from smplxpp.core.params import BodyParams
from smplxpp.core.template import BODY_PART, Template
from smplxpp.export.gltf_animation import add_animation
from smplxpp.export.gltf_buffer import GltfBuffer
from smplxpp.export.gltf_skin import add_skeleton, influence_sets


def write_glb(
    path: str | Path, template: Template, *, animation: BodyParams | None = None, morph_targets: bool = True
) -> None:
    """Write the template as binary glTF 2.0, whole or not at all.

    One mesh and one material a part, named after it, all bound to one skeleton; colours as scanned, in linear light as
    glTF asks. Metres, +Y up, facing +Z: glTF's own axes. What glTF has no room for is left out: pose correctives, and
    influences beyond the eight largest of a vertex. Expressions move the surface alone, not the joints.

    Args:
        path: ends in .glb.
        template: what to write.
        animation: T frames of motion, at their own frame rate or 30 a second.
        morph_targets: write the body's expressions as morph targets `expression_00`, ...

    Raises:
        InputError: another suffix, an animation without frames or that the body refuses.
    """
    path = Path(path)
    if path.suffix.lower() != ".glb":
        raise InputError("GLB file", expected="a name that ends in .glb", received=path.name)
    if animation is not None and not len(animation):
        raise InputError("animation", expected="at least one frame", received="none")
    generator = f"smplxpp {metadata.version('smplxpp')}"
    document = gl.GLTF2(asset=gl.Asset(version="2.0", generator=generator), scene=0)
    buffer = GltfBuffer(document)
    skin = add_skeleton(document, buffer, template)
    morphs = morph_targets and template.expression_basis.shape[2] > 0
    weights = influence_sets(template.weights)
    normals = _normals(template)
    for index, name in enumerate(template.part_names):
        _add_part(document, buffer, template, index, weights, normals, morphs and name == BODY_PART)
        document.nodes.append(gl.Node(name=name, mesh=len(document.meshes) - 1, skin=skin))
    roots = np.flatnonzero(template.parents < 0).tolist()
    document.scenes = [gl.Scene(nodes=[*roots, *range(template.joint_count, len(document.nodes))])]
    if animation is not None:
        add_animation(document, buffer, template, animation, template.joint_count if morphs else None)
    buffer.finish()
    atomic_write_bytes(path, b"".join(document.save_to_bytes()))


def linear_from_srgb(colors: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 sRGB -> (N, 3) linear light in [0, 1] (IEC 61966-2-1)."""
    c = np.asarray(colors, dtype=np.float64) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def _normals(template: Template) -> np.ndarray:
    """(V, 3) float32 unit normals; +Y where a vertex has no face."""
    normals = template.mesh.vertex_normals.astype(np.float32)
    normals[(normals == 0).all(axis=1)] = (0.0, 1.0, 0.0)
    return normals


def _add_part(
    document: gl.GLTF2,
    buffer: GltfBuffer,
    template: Template,
    index: int,
    weights: list[tuple[np.ndarray, np.ndarray]],
    normals: np.ndarray,
    morphs: bool,
) -> None:
    name = template.part_names[index]
    of_part = np.flatnonzero(template.vertex_part == index)
    first, rows = int(of_part[0]), slice(int(of_part[0]), int(of_part[-1]) + 1)
    label = LABELS[int(template.vertex_labels[first])]
    document.materials.append(
        gl.Material(
            name=name,
            pbrMetallicRoughness=gl.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=0.9),
            # Garments are one sheet: their inside shows at hems and cuffs.
            doubleSided=name != BODY_PART,
            alphaCutoff=None,
            extras={"label": label.name, "semantic_rgb": list(label.semantic_rgb)},
        )
    )
    linear = np.ones((len(of_part), 4))
    linear[:, :3] = linear_from_srgb(template.vertex_colors[rows])
    attributes = {
        "POSITION": buffer.add(template.vertices[rows].astype(np.float32), target=gl.ARRAY_BUFFER, bounds=True),
        "NORMAL": buffer.add(normals[rows], target=gl.ARRAY_BUFFER),
        "COLOR_0": buffer.add((linear * 65535 + 0.5).astype(np.uint16), target=gl.ARRAY_BUFFER, normalized=True),
    }
    for k, (joints, values) in enumerate(weights):
        attributes[f"JOINTS_{k}"] = buffer.add(joints[rows], target=gl.ARRAY_BUFFER)
        attributes[f"WEIGHTS_{k}"] = buffer.add(values[rows], target=gl.ARRAY_BUFFER)
    primitive = gl.Primitive(
        attributes=gl.Attributes(**attributes),
        indices=buffer.add_indices(template.faces[template.part_faces(name)] - first, len(of_part)),
        material=len(document.materials) - 1,
        mode=gl.TRIANGLES,
    )
    mesh = gl.Mesh(name=name, primitives=[primitive])
    if morphs:
        count = template.expression_basis.shape[2]
        primitive.targets = [{"POSITION": buffer.add_sparse(template.expression_basis[..., k])} for k in range(count)]
        mesh.weights = [0.0] * count
        mesh.extras = {"targetNames": [f"expression_{k:02d}" for k in range(count)]}
    document.meshes.append(mesh)
