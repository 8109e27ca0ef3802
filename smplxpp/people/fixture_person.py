"""The fixture person: the open body and her clothes as layers in the T-pose, with skinning weights and colours."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from smplxpp.body import BodyModel, load_body
from smplxpp.core import BodyParams, InputError, TriangleMesh
from smplxpp.core.files.array_file import read_arrays
from smplxpp.people import textures
from smplxpp.people.cloth_mesh import (
    ClothMesh,
    clip,
    lengthened,
    lift_outside,
    loop_subdivide,
    lowest_loop,
    outer_faces,
    smooth,
    submesh,
)
from smplxpp.people.textures import skirt_colors
from smplxpp.skinning import skin

PART_NAMES = ("body", "upper", "lower", "shoes", "hair")
LABEL_NAMES = ("background", "skin", "hair", "shoes", "upper", "lower", "other")
PART_LABELS = np.array([1, 4, 5, 3, 2], dtype=np.uint8)
"""Label of each part."""
CLOTHES = ("skirt", "trousers")
SKIRT_LENGTHS = ("knee", "calf")
PERSON_BETAS = np.array([0.35, 1.4, 0.3, 0.6] + [0.0] * 16)
"""Shape coefficients of the person: an adult woman of about average height."""


@dataclass(frozen=True, eq=False)
class Person:
    """All layers as one mesh; the body's vertices come first, in the body model's order.

    Attributes:
        tpose: V vertices and M faces; parts share no vertices.
        weights: authored skinning weights.
        vertex_part: index into `PART_NAMES` of each vertex.
        face_part: index into `PART_NAMES` of each face.
        vertex_label: index into `LABEL_NAMES` of each vertex; eyes, teeth and tongue are "other".
        betas: shape coefficients of the body.
        body: the body model; `exprdirs` moves its vertices, the other parts do not follow the face.
        face: landmarks on the T-pose, for the colours.
        clothes: one of `CLOTHES`, the part "lower".
        skirt_pattern: name in `patterns.SKIRT_PATTERNS`.
        skirt_length: one of `SKIRT_LENGTHS`; a pattern is spread evenly along the hem of the longer one.
    """

    tpose: TriangleMesh
    weights: Float[np.ndarray, "V 55"]
    vertex_part: UInt8[np.ndarray, " V"]
    face_part: UInt8[np.ndarray, " M"]
    vertex_label: UInt8[np.ndarray, " V"]
    betas: Float[np.ndarray, " 20"]
    body: BodyModel
    face: textures.FaceMarks
    clothes: str = "skirt"
    skirt_pattern: str = "plaid"
    skirt_length: str = "knee"

    def posed(self, params: BodyParams) -> tuple[Float[np.ndarray, "T V 3"], Float[np.ndarray, "T 55 4 4"]]:
        """Pose every layer by linear blend skinning; return its vertices and the joints' transforms from rest."""
        posed = self.body.forward(params)
        # Expressions change the body's rest shape, not that of clothes.
        rest = np.repeat(self.tpose.vertices[None], len(params), axis=0)
        rest[:, : self.body.vertex_count] = posed.rest_vertices
        return skin(rest, self.weights, posed.posed_from_rest), posed.posed_from_rest

    @property
    def joints(self) -> dict[str, Float[np.ndarray, " 3"]]:
        """Joint positions in the T-pose by name, metres."""
        return rest_joints(self.body, self.tpose.vertices[: self.body.vertex_count])

    def colors(
        self, points: Float[np.ndarray, "P 3"], part: UInt8[np.ndarray, " P"], label: UInt8[np.ndarray, " P"]
    ) -> UInt8[np.ndarray, "P 3"]:
        """Return the sRGB colours of points on the T-pose, given the part and the label of each."""
        joint = self.joints
        out = np.zeros((len(points), 3))
        left = points[:, 0] > 0
        eye = np.where(left[:, None], joint["left_eye_smplhf"], joint["right_eye_smplhf"])
        for k, name in enumerate(PART_NAMES):
            own = part == k
            if name == "body":
                # Labels tell eyes from teeth and tongue by the distance from the eyes' centres.
                out[own] = textures.skin_colors(points[own], self.face, seed=1)
                own &= (label == LABEL_NAMES.index("other")) & (np.linalg.norm(points - eye, axis=1) < 0.02)
                out[own] = textures.eye_colors(points[own] - eye[own])
            elif name == "upper":
                out[own] = textures.shirt_colors(points[own], joint["left_shoulder"])
            elif name == "lower":
                if self.clothes == "skirt":
                    hem = None if self.skirt_length == "knee" else self._hem
                    out[own] = skirt_colors(points[own], joint["pelvis"][2], self.skirt_pattern, hem)
                else:
                    out[own] = textures.trouser_colors(points[own], joint["left_hip"], joint["left_ankle"])
            elif name == "shoes":
                out[own] = textures.shoe_colors(points[own], self.tpose.vertices[:, 1].min())
            else:
                out[own] = textures.hair_colors(points[own], seed=2)
        return np.clip(out, 0, 255).astype(np.uint8)

    @cached_property
    def _hem(self) -> Float[np.ndarray, "L 3"]:
        mesh = self.tpose.submesh(self.face_part == PART_NAMES.index("lower"))[0]
        return mesh.vertices[lowest_loop(mesh)]


def face_marks(landmarks: Float[np.ndarray, "51 3"]) -> textures.FaceMarks:
    """Return the landmarks that are painted, of those in dlib's order from 17."""
    return textures.FaceMarks(brows=landmarks[:10], eyes=landmarks[19:31], lips=landmarks[31:43])


def load_person(topology_file: Path, clothes: str = "skirt", skirt_length: str = "knee") -> Person:
    """Return the person of `geometry/topology.npz` of the fixture, in one of `CLOTHES`.

    Raises:
        InputError: a missing file, missing keys, or parts that are not the fixture person's.
    """
    return person_of(read_layers(topology_file, clothes, skirt_length), clothes, skirt_length)


def read_layers(topology_file: Path, clothes: str = "skirt", skirt_length: str = "knee") -> dict[str, np.ndarray]:
    """Return the arrays of `geometry/topology.npz`, with the layers of her clothes.

    Raises:
        InputError: a missing file, missing keys, or parts that are not the fixture person's.
    """
    if not topology_file.is_file():
        raise InputError(
            "person",
            expected="a file geometry/topology.npz of the fixture person",
            received=str(topology_file),
            remedy="run in a checkout, or name the folder with --person",
        )
    arrays = read_arrays(topology_file, subject="person")
    needed = ("v_tpose", "faces", "face_part", "vertex_part", "vertex_label", "weights", "betas", "part_names")
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise InputError(f"file {topology_file}", expected=f"the key {missing[0]}", received=", ".join(arrays))
    # Clothes and motions are modelled on this person's parts; on others they would be meaningless.
    parts = tuple(arrays["part_names"].tolist())
    if parts != PART_NAMES:
        raise InputError(f"file {topology_file}", expected=f"parts {PART_NAMES}", received=str(parts))
    if clothes == "trousers":
        return with_trousers(arrays, load_body())
    return arrays if skirt_length == "knee" else with_calf_skirt(arrays, load_body())


def person_of(arrays: dict[str, np.ndarray], clothes: str = "skirt", skirt_length: str = "knee") -> Person:
    """Return the person whose arrays `read_layers` returned."""
    return Person(
        tpose=TriangleMesh(arrays["v_tpose"], arrays["faces"]),
        weights=arrays["weights"].astype(np.float64),
        vertex_part=arrays["vertex_part"],
        face_part=arrays["face_part"],
        vertex_label=arrays["vertex_label"],
        betas=arrays["betas"].astype(np.float64),
        body=load_body(),
        face=face_marks(face_landmarks()),
        clothes=clothes,
        skirt_length=skirt_length,
    )


def rest_joints(body: BodyModel, skin: Float[np.ndarray, "V 3"]) -> dict[str, Float[np.ndarray, " 3"]]:
    """Return the joint positions of the body's vertices in the T-pose by name, metres."""
    return dict(zip(body.joint_names, body.joint_regressor @ skin, strict=True))


def face_landmarks(betas: Float[np.ndarray, " B"] = PERSON_BETAS) -> Float[np.ndarray, "51 3"]:
    """Return the face landmarks on the open body's T-pose at shape coefficients, in dlib's order from 17."""
    with resources.as_file(resources.files("smplxpp") / "data" / "open_body.npz") as path:
        data = read_arrays(path, subject="open body")
    shaped = data["v_template"] + data["shapedirs"][..., : len(betas)] @ betas
    corners = shaped[data["f"][data["lmk_faces_idx"]]]
    return np.einsum("lk,lkx->lx", data["lmk_bary_coords"], corners)


def make_trousers(body: BodyModel, skin: Float[np.ndarray, "V 3"]) -> ClothMesh:
    """Return tight trousers cut from the skin, which follow the body's skinning exactly.

    Args:
        body: gives faces, weights and joints.
        skin: its vertices in the T-pose, metres.
    """
    joint, outer = rest_joints(body, skin), outer_faces(body)
    # Cut 12 mm above the pelvis joint and 35 mm above the ankles'. Only legs and pelvis are this low in the T-pose.
    whole = submesh(ClothMesh(skin, body.faces, body.weights), outer)
    legs = clip(whole, joint["pelvis"][1] + 0.012 - whole.vertices[:, 1])
    legs = clip(legs, legs.vertices[:, 1] - joint["left_ankle"][1] - 0.035)
    # Smoothing lets the cloth span small hollows of the skin; then it keeps 4 mm off the skin.
    cloth = loop_subdivide(legs)
    vertices = smooth(cloth.mesh, cloth.vertices, steps=6)
    inner = TriangleMesh(skin, body.faces[outer])
    return cloth.with_vertices(lift_outside(cloth.mesh.with_vertices(vertices), inner, clearance=0.004, solid=True))


def with_trousers(arrays: dict[str, np.ndarray], body: BodyModel) -> dict[str, np.ndarray]:
    """Return the arrays of a person's `topology.npz` with trousers in place of the skirt.

    Args:
        arrays: arrays of the file; the body's vertices come first.
        body: body model of the person.
    """
    return _with_lower(arrays, make_trousers(body, arrays["v_tpose"][: body.vertex_count].astype(np.float64)))


def with_calf_skirt(arrays: dict[str, np.ndarray], body: BodyModel) -> dict[str, np.ndarray]:
    """Return the arrays of a person's `topology.npz` with the skirt lengthened to the middle of the calves.

    Args:
        arrays: arrays of the file; the body's vertices come first.
        body: body model of the person.
    """
    faces = arrays["faces"][arrays["face_part"] == arrays["part_names"].tolist().index("lower")]
    used = np.unique(faces)
    skirt = ClothMesh(arrays["v_tpose"][used].astype(np.float64), np.searchsorted(used, faces), arrays["weights"][used])
    skin = arrays["v_tpose"][: body.vertex_count].astype(np.float64)
    joint = rest_joints(body, skin)
    hem = 0.5 * (joint["left_knee"][1] + joint["left_ankle"][1])
    return _with_lower(arrays, lengthened(skirt, hem, joint["pelvis"][2]))


def _with_lower(arrays: dict[str, np.ndarray], cloth: ClothMesh) -> dict[str, np.ndarray]:
    """Return the arrays of a person's `topology.npz` with other cloth as the part "lower"."""
    # It takes the place of the skirt's vertices and faces; what follows them moves up or down.
    part = arrays["part_names"].tolist().index("lower")
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

    # Arrays of the new vertices, in the types of the old ones.
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
