"""What the person wears below: the loose skirt that she comes with, or tight trousers cut from her own skin."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pipelines.synth.cloth_mesh import ClothMesh, clip, loop_subdivide, push_out, smooth, submesh
from smplxpp.body import BodyModel
from smplxpp.core.mesh import TriangleMesh

CLOTHES = ("skirt", "trousers")

# Where trousers end: metres above the pelvis joint and above the ankles'.
_WAIST, _ANKLE = 0.012, 0.035
_EASE = 0.004  # metres off the skin
_FAIRING = 6  # rounds of smoothing: cloth spans the small hollows of the skin


def make_trousers(body: BodyModel, skin: Float[np.ndarray, "V 3"]) -> ClothMesh:
    """Cut trousers that follow the body's skinning exactly.

    Args:
        body: gives faces, weights and joints.
        skin: its vertices in the T-pose, metres.
    """
    joint = dict(zip(body.joint_names, body.joint_regressor @ skin, strict=True))
    outer = body.part_labels == body.part_label_names.index("body")
    # In the T-pose nothing but legs and pelvis is this low.
    whole = submesh(ClothMesh(skin, body.faces, body.weights), outer[body.faces].all(axis=1))
    legs = clip(whole, joint["pelvis"][1] + _WAIST - whole.vertices[:, 1])
    legs = clip(legs, legs.vertices[:, 1] - joint["left_ankle"][1] - _ANKLE)
    cloth = loop_subdivide(legs)
    vertices = smooth(cloth.mesh, cloth.vertices, steps=_FAIRING)
    inner = TriangleMesh(skin, body.faces[outer[body.faces].all(axis=1)])
    return cloth.with_vertices(push_out(cloth.mesh.with_vertices(vertices), inner, clearance=_EASE, solid=True))


def with_trousers(arrays: dict[str, np.ndarray], body: BodyModel) -> dict[str, np.ndarray]:
    """Return the arrays of a person's `topology.npz` with trousers in place of the skirt.

    Args:
        arrays: as the file has them; the body's vertices come first.
        body: of the person.
    """
    part = arrays["part_names"].tolist().index("lower")
    cloth = make_trousers(body, arrays["v_tpose"][: body.vertex_count].astype(np.float64))
    vertex_part, face_part = arrays["vertex_part"], arrays["face_part"]
    first = int(np.flatnonzero(vertex_part == part)[0])
    kept = np.flatnonzero(vertex_part != part)
    before = kept[kept < first]
    added, gone = len(cloth.vertices), int((vertex_part == part).sum())
    new_index = np.arange(len(vertex_part)) + (added - gone) * (np.arange(len(vertex_part)) > first)
    face_first = int(np.flatnonzero(face_part == part)[0])
    faces_kept = np.flatnonzero(face_part != part)
    faces_before = faces_kept[faces_kept < face_first]

    def spliced(old: np.ndarray, new: np.ndarray, kept: np.ndarray, before: np.ndarray) -> np.ndarray:
        return np.concatenate([old[before], new.astype(old.dtype), old[kept[len(before) :]]])

    like = np.zeros(added)
    own: dict[str, np.ndarray] = {
        "v_tpose": cloth.vertices,
        "weights": cloth.weights / cloth.weights.sum(axis=1, keepdims=True),
        "vertex_part": like + part,
        "vertex_label": like + arrays["vertex_label"][first],
    }
    if "exprdirs" in arrays:
        own["exprdirs"] = np.zeros((added, *arrays["exprdirs"].shape[1:]))
    out = dict(arrays) | {name: spliced(arrays[name], value, kept, before) for name, value in own.items()}
    faces = new_index[arrays["faces"]]
    out["faces"] = spliced(faces, cloth.faces + first, faces_kept, faces_before).astype(arrays["faces"].dtype)
    out["face_part"] = spliced(face_part, np.full(len(cloth.faces), part), faces_kept, faces_before)
    return {name: value for name, value in out.items() if name not in ("face_hidden", "pin")}
