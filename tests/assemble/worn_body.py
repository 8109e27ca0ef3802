"""The open body in a tunic and a cap cut from its own skin: small, and every number is known."""

from __future__ import annotations

import numpy as np

from smplxpp.assemble import CanonicalPart
from smplxpp.body import BodyModel
from smplxpp.core import HAIR, UPPER, BodyParams, SkinWeights, TriangleMesh

BETAS = np.array([0.8, -0.5, 0.3])


def shell(body: BodyModel, joints: list[str], *, offset: float, label: int, top: float = 3.0) -> CanonicalPart:
    """The skin owned by some joints (its uppermost `top` metres), moved out by `offset` metres, with its weights."""
    rest = body.forward(BodyParams.rest(betas=BETAS)).rest_vertices[0]
    mesh = body.mesh(rest)
    owner = body.weights[:, [body.joint_names.index(name) for name in joints]].sum(axis=1)
    owned = (owner > 0.6) & (body.part_labels == 0)
    owned &= rest[:, 1] >= rest[owned, 1].max() - top
    chosen = owned[mesh.faces].all(axis=1)
    part, used = TriangleMesh(rest + offset * mesh.vertex_normals, mesh.faces).submesh(chosen)
    colors = np.random.default_rng(0).integers(0, 256, (len(used), 3)).astype(np.uint8)
    return CanonicalPart(part, SkinWeights.from_dense(body.weights[used]), label, colors, np.arange(len(used)) + 7)


def worn_parts(body: BodyModel, *, offset: float = 0.004) -> dict[str, CanonicalPart]:
    """A tunic and a cap at a given distance from the skin."""
    torso = ["pelvis", "spine1", "spine2", "spine3"]
    return {
        "tunic": shell(body, torso, offset=offset, label=UPPER.id),
        "cap": shell(body, ["head"], offset=offset, label=HAIR.id, top=0.06),
    }


def params() -> BodyParams:
    """The identity of the parts."""
    return BodyParams.rest(betas=BETAS)
