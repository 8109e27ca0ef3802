"""Convert closed meshes to manifold3d's solids, for robust boolean operations, and back."""

from __future__ import annotations

import manifold3d
import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.topology import border_loops


def solid_of_mesh(mesh: TriangleMesh, *, subject: str = "solid") -> manifold3d.Manifold:
    """Convert a closed, consistently wound mesh to a solid; it may have several pieces and intersect itself.

    Raises:
        InputError: an open mesh, edges with more than two faces, or none.
    """
    made = manifold3d.Manifold(manifold3d.Mesh64(np.array(mesh.vertices), mesh.faces.astype(np.uint64)))
    if made.status() != manifold3d.Error.NoError or made.is_empty():
        raise InputError(
            subject,
            expected="a closed surface, two faces at each edge, wound alike",
            received=f"{len(mesh.border_edges)} border edges"
            if len(mesh.border_edges)
            else f"{mesh.face_count} faces that enclose nothing ({made.status().name})",
            remedy="close it with smplxpp.core.solids.closed_mesh, or give it a thickness",
        )
    return made


def mesh_of_solid(solid: manifold3d.Manifold) -> TriangleMesh:
    """Return the surface mesh of a solid."""
    found = solid.to_mesh64()
    return TriangleMesh(np.asarray(found.vert_properties)[:, :3], np.asarray(found.tri_verts).astype(np.int64))


def closed_mesh(mesh: TriangleMesh) -> TriangleMesh:
    """Close each border of a manifold mesh by a fan about its centroid; new vertices and faces come last."""
    vertices, faces = [mesh.vertices], [mesh.faces]
    for k, loop in enumerate(border_loops(mesh.faces)):
        vertices.append(mesh.vertices[loop].mean(axis=0)[None])
        # The hole's faces run against the border's direction.
        faces.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), mesh.vertex_count + k)], axis=1))
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces))
