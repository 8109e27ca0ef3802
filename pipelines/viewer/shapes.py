"""Meshes and colours as the browser draws them."""

from __future__ import annotations

import numpy as np
import pygltflib
from jaxtyping import Float64, Int, Int64, UInt8
from pygltflib import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER

from pipelines.figures.colors import heat_colors
from smplxpp.core.labels import LABELS, display_colors
from smplxpp.core.mesh import TriangleMesh
from smplxpp.export.gltf_buffers import BufferBuilder, index_dtype
from smplxpp.export.gltf_mesh import linear_rgba16

MOST_SPLIT_FACES = 250_000
"""Scans of more faces are drawn with colours of vertices: every face with corners of its own would take too long."""
_LIFT = 0.0007
"""Metres by which what is painted lies above the scan."""


def label_colors(labels: Int[np.ndarray, " M"]) -> UInt8[np.ndarray, "M 3"]:
    """Display colours of labels."""
    return display_colors(labels)


def confidence_colors(confidence: Float64[np.ndarray, " M"]) -> UInt8[np.ndarray, "M 3"]:
    """Pale where labels are sure, dark red where they are not."""
    return heat_colors(1.0 - confidence, cmap="error", limits=(0.0, 1.0))


def colored_glb(
    mesh: TriangleMesh,
    *,
    face_colors: UInt8[np.ndarray, "M 3"] | None = None,
    vertex_colors: UInt8[np.ndarray, "N 3"] | None = None,
) -> bytes:
    """A GLB of a mesh with colours of its faces or its vertices, dull as cloth, seen from both sides."""
    if face_colors is not None and mesh.face_count <= MOST_SPLIT_FACES:
        corners = np.arange(3 * mesh.face_count).reshape(-1, 3)
        rows = mesh.faces.reshape(-1)
        return _glb(mesh.vertices[rows], mesh.vertex_normals[rows], np.repeat(face_colors, 3, axis=0), corners)
    if face_colors is not None:
        vertex_colors = np.zeros((mesh.vertex_count, 3), dtype=np.uint8)
        vertex_colors[mesh.faces] = face_colors[:, None]
    assert vertex_colors is not None, "one of both is given"
    return _glb(mesh.vertices, mesh.vertex_normals, vertex_colors, mesh.faces)


def painted_glb(mesh: TriangleMesh, faces: Int64[np.ndarray, " n"], colors: UInt8[np.ndarray, "n 3"]) -> bytes:
    """A GLB of some of a mesh's faces in these colours, a little above it."""
    rows = mesh.faces[faces].reshape(-1)
    normals = mesh.vertex_normals[rows]
    corners = np.arange(len(rows)).reshape(-1, 3)
    return _glb(mesh.vertices[rows] + _LIFT * normals, normals, np.repeat(colors, 3, axis=0), corners)


def _glb(vertices: np.ndarray, normals: np.ndarray, colors: np.ndarray, faces: np.ndarray) -> bytes:
    gltf = pygltflib.GLTF2(asset=pygltflib.Asset(version="2.0"))
    buffers = BufferBuilder(gltf)
    attributes = pygltflib.Attributes(
        POSITION=buffers.add(vertices.astype(np.float32), target=ARRAY_BUFFER, bounds=True),
        NORMAL=buffers.add(normals.astype(np.float32), target=ARRAY_BUFFER),
        COLOR_0=buffers.add(linear_rgba16(colors), target=ARRAY_BUFFER, normalized=True),
    )
    indices = buffers.add(faces.reshape(-1).astype(index_dtype(len(vertices))), target=ELEMENT_ARRAY_BUFFER)
    dull = pygltflib.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=1.0)
    gltf.materials = [pygltflib.Material(pbrMetallicRoughness=dull, doubleSided=True)]
    gltf.meshes = [pygltflib.Mesh(primitives=[pygltflib.Primitive(attributes=attributes, indices=indices, material=0)])]
    gltf.nodes, gltf.scenes, gltf.scene = [pygltflib.Node(mesh=0)], [pygltflib.Scene(nodes=[0])], 0
    return buffers.glb()


def legend(labels: Int64[np.ndarray, " M"], areas: Float64[np.ndarray, " M"]) -> str:
    """The labels, their colours and shares of the surface, as HTML."""
    share = np.bincount(labels, areas, minlength=len(LABELS)) / areas.sum()
    rows = (
        f'<div style="display:flex;gap:.5em;align-items:center"><span style="width:1em;height:1em;border-radius:.2em;'
        f'background:rgb{label.display_rgb}"></span><span style="flex:1">{label.name}</span>'
        f"<span>{100 * share[label.id]:.1f} %</span></div>"
        for label in LABELS
    )
    return f'<div style="padding:0 .8em .4em .8em;font-size:.85em">{"".join(rows)}</div>'
