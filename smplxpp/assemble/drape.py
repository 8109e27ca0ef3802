"""Drape patches that close cuts over the body: round a limb, at the distance from the skin that their rims have.

A patch of least area goes straight from rim to rim; under a sleeve whose lower side was fused with the trunk it would
go through the arm. Its new vertices x are moved in three steps:

    1. bend    x minimises |L x|^2 (L: the uniform Laplacian), so that the patch continues in the direction of its rim
    2. blow    vertices that are still in the body move out along the patch's normal, and the others follow by 1
    3. settle  x falls to a membrane (Jacobi steps), but keeps signed distance(x) >= s from the body

s is the harmonic function of the rim's own distances, so that a wide sleeve stays wide.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool
from scipy.sparse import diags, identity
from scipy.sparse.linalg import spsolve

from smplxpp.assemble.build import CanonicalPart
from smplxpp.core import TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.topology import mean_of_neighbours

STAND_OFF = (0.003, 0.04)
"""Bounds of the distance that a patch keeps from the skin, metres: cloth lies 2 to 5 mm off; the 4 cm of a wide sleeve
are not taken farther out."""
_BLOW, _BLOW_STEP, _BLOW_PULL = 2, 0.02, 0.1
"""Steps of blowing up; the move that is asked of a vertex in the body, metres, less than a limb's radius; its weight
beside the patch's bending. Two steps clear a sleeve of which a third is left; more crumple a coarse patch."""
_SETTLE = 20
"""Steps of settling. Uniform weights let vertices drift along a limb, so that more of them fold a patch at its rim."""


def drape_patches(part: CanonicalPart, new: Bool[np.ndarray, " N"], body: TriangleMesh) -> CanonicalPart:
    """Move the new vertices of patches out of the body, and to the distance from it that their rims have.

    Vertices inside of the body move along the patch's normal, which points out of the person, until they are outside.
    The gradient of the distance would lead half of them to the far side of the limb.

    Args:
        part: in the T-pose, with patches.
        new: its vertices that patches have added; the others stay.
        body: at rest, closed.
    """
    if not new.any():
        return part
    field, free = SignedDistanceField(body, solid=True), np.flatnonzero(new)
    mean = mean_of_neighbours(part.mesh.edges, part.mesh.border_edges, part.mesh.vertex_count)
    # The stand-off is harmonic between the rim's distances.
    wanted = np.zeros(part.mesh.vertex_count)
    rim = np.unique(part.mesh.faces[new[part.mesh.faces].any(axis=1)])
    rim = rim[~new[rim]]
    wanted[rim] = np.clip(field.query(part.mesh.vertices[rim]).distance, *STAND_OFF)
    laplacian = (identity(len(wanted)) - mean).tocsr()[free]
    off = spsolve(laplacian[:, free].tocsc(), -laplacian[:, rim] @ wanted[rim])
    # The surface that continues as its rim does has the least squared Laplacian over new and rim vertices: it bends
    # round a limb where a membrane goes across.
    x, rows = part.mesh.vertices.copy(), (identity(len(wanted)) - mean).tocsr()[np.concatenate([free, rim])]
    bent, known = rows[:, free], rows @ np.where(new[:, None], 0.0, x)
    x[free] = spsolve((bent.T @ bent).tocsc(), -(bent.T @ known))
    # Vertices that are too near are drawn out, and the others follow.
    for _ in range(_BLOW):
        found = field.query(x[free])
        near = found.distance < 0.5 * off
        if not near.any():
            break
        normal = part.mesh.with_vertices(x).vertex_normals[free]
        outward = np.einsum("ij,ij->i", found.gradient, normal) > 0.3
        moved = x[free] + (off - found.distance)[:, None] * found.gradient
        moved = np.where(outward[:, None], moved, x[free] + _BLOW_STEP * normal)
        drawn = _BLOW_PULL * diags(near.astype(float))
        x[free] = spsolve((bent.T @ bent + drawn).tocsc(), drawn @ moved - bent.T @ known)
    # Then let it fall to the membrane; what comes too near returns along the gradient, which points outwards now.
    for _ in range(_SETTLE):
        x[free] = mean[free] @ x
        found = field.query(x[free])
        near = found.distance < off
        x[free[near]] += ((off - found.distance)[:, None] * found.gradient)[near]
    return replace(part, mesh=part.mesh.with_vertices(x))
