"""The fixture person is dressed: the open body and clothes cut from the base mesh as layers."""

from __future__ import annotations

import numpy as np

from pipelines.synth.person import LABEL_NAMES, PART_LABELS, PERSON_BETAS, Person, face_marks
from smplxpp.body import BodyModel
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from tools.anny_base import BaseMesh
from tools.garments import DressForm, make_shirt, make_shoes, make_skirt
from tools.hair import make_hair


def make_person(base: BaseMesh, body: BodyModel, *, landmarks: np.ndarray, seed: int) -> Person:
    """Dress the body.

    Args:
        base: the base mesh that the body was made from.
        body: the open body.
        landmarks: (51, 3) face landmarks on the body's T-pose at `PERSON_BETAS`.
        seed: of folds and strands.
    """
    form = DressForm.of(base, PERSON_BETAS)
    skirt = make_skirt(form, seed=seed)
    shirt = make_shirt(form, under=skirt.mesh, seed=seed + 1)
    clothes = [shirt, skirt, make_shoes(form), make_hair(form, seed=seed + 2)]
    rest = body.forward(BodyParams.rest(betas=PERSON_BETAS, expressions=body.num_expressions)).rest_vertices[0]
    vertices = [rest, *(c.vertices for c in clothes)]
    offsets = np.cumsum([0] + [len(v) for v in vertices])[:-1]
    faces = [f + o for f, o in zip([body.faces, *(c.faces for c in clothes)], offsets, strict=True)]
    vertex_part = np.repeat(np.arange(len(vertices)), [len(v) for v in vertices]).astype(np.uint8)
    vertex_label = PART_LABELS[vertex_part]
    inner = np.flatnonzero(body.part_labels != body.part_label_names.index("body"))
    vertex_label[inner] = LABEL_NAMES.index("other")
    return Person(
        tpose=TriangleMesh(np.concatenate(vertices), np.concatenate(faces)),
        weights=np.concatenate([body.weights, *(c.weights for c in clothes)]),
        vertex_part=vertex_part,
        face_part=np.repeat(np.arange(len(faces)), [len(f) for f in faces]).astype(np.uint8),
        vertex_label=vertex_label,
        betas=PERSON_BETAS,
        body=body,
        face=face_marks(landmarks),
    )
