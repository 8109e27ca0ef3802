"""Remove small components of a part, close its pinholes, and measure its openings."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int, Int64

from smplxpp.core.foreign import MeshLike, as_mesh
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.topology import border_loops, face_components


def drop_specks(mesh: MeshLike, *, area_fraction: float = 1e-3) -> Bool[np.ndarray, " M"]:
    """Return the faces of components with at least `area_fraction` of the mesh's area; the largest is always kept."""
    mesh = as_mesh(mesh, subject="mesh")
    component = face_components(mesh.faces)
    area = np.bincount(component, mesh.face_areas)
    kept = area >= area_fraction * area.sum()
    kept[np.argmax(area)] = True
    return kept[component]


def loop_lengths(mesh: MeshLike, loops: list[Int[np.ndarray, " _"]]) -> Float64[np.ndarray, " L"]:
    """Return the perimeter of each closed loop of vertex indices, metres."""
    mesh = as_mesh(mesh, subject="mesh")
    positions = [mesh.vertices[loop] for loop in loops]
    return np.array([np.linalg.norm(p - np.roll(p, -1, axis=0), axis=1).sum() for p in positions])


def fill_pinholes(mesh: MeshLike, *, max_length: float = 0.04) -> tuple[TriangleMesh, Int64[np.ndarray, " n"]]:
    """Close border loops shorter than `max_length` metres; longer ones are openings (hem, cuffs, neck) and stay.

    A loop of three edges is closed by one triangle, a longer one by a fan around its mean. The border of a component
    that is itself no larger than the hole is not a hole.

    Args:
        mesh: manifold.
        max_length: perimeter from which a loop is an opening.

    Returns:
        The manifold mesh, with new vertices and faces at the end, and for every vertex the vertex of `mesh` that it is,
        or for a fan's centre the loop vertex nearest to it.
    """
    mesh = as_mesh(mesh, subject="mesh")
    loops = border_loops(mesh.faces)
    if not loops:
        return mesh, np.arange(mesh.vertex_count)
    component = face_components(mesh.faces)
    area = np.bincount(component, mesh.face_areas)
    component_of_vertex = np.zeros(mesh.vertex_count, dtype=np.int64)
    component_of_vertex[mesh.faces] = component[:, None]
    lengths = loop_lengths(mesh, loops)
    vertices, faces, source = [mesh.vertices], [mesh.faces], [np.arange(mesh.vertex_count)]
    next_vertex = mesh.vertex_count
    for loop, length in zip(loops, lengths, strict=True):
        # A hole with this perimeter has an area of at most length^2 / (4 pi); a component below length^2 is a speck
        # with an outer border.
        if length > max_length or area[component_of_vertex[loop[0]]] < length**2:
            continue
        # The closing faces traverse the border in the opposite direction.
        if len(loop) == 3:
            faces.append(loop[::-1][None])
            continue
        center = mesh.vertices[loop].mean(axis=0)
        nearest = loop[np.argmin(np.linalg.norm(mesh.vertices[loop] - center, axis=1))]
        faces.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), next_vertex)], axis=1))
        vertices.append(center[None])
        source.append(np.array([nearest]))
        next_vertex += 1
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces)), np.concatenate(source)
