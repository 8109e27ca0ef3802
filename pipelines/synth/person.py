"""The fixture person: the open body and her clothes as layers in the T-pose, with authored weights and colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from pipelines.synth import textures
from pipelines.synth.skirt_patterns import skirt_colors
from smplxpp.body import BodyModel
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.skinning import skin

PART_NAMES = ("body", "upper", "lower", "shoes", "hair")
LABEL_NAMES = ("background", "skin", "hair", "shoes", "upper", "lower", "other")
PART_LABELS = np.array([1, 4, 5, 3, 2], dtype=np.uint8)
_OTHER = LABEL_NAMES.index("other")

# Shape of the person: an adult woman of about average height.
PERSON_BETAS = np.array([0.35, 1.4, 0.3, 0.6] + [0.0] * 16)


@dataclass(frozen=True, eq=False)
class Person:
    """All layers as one mesh; the body's vertices come first, in the body model's order.

    Attributes:
        tpose: V vertices, M faces; parts share no vertices.
        weights: authored skinning weights.
        vertex_part, face_part: indices into `PART_NAMES`.
        vertex_label: indices into `LABEL_NAMES`; eyes, teeth and tongue are "other".
        betas: shape of the body.
        body: the body model; `exprdirs` moves its vertices, the other parts do not follow the face.
        face: landmarks on the T-pose, for the colours.
        clothes: what the part "lower" is.
        skirt_pattern: among `skirt_patterns.PATTERNS`.
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

    def posed(self, params: BodyParams) -> tuple[Float[np.ndarray, "T V 3"], Float[np.ndarray, "T 55 4 4"]]:
        """Pose every layer by linear blend skinning; return its vertices and the joints' transforms from rest."""
        posed = self.body.forward(params)
        rest = np.repeat(self.tpose.vertices[None], len(params), axis=0)
        rest[:, : self.body.vertex_count] = posed.rest_vertices
        return skin(rest, self.weights, posed.posed_from_rest), posed.posed_from_rest

    def colors(
        self, points: Float[np.ndarray, "P 3"], part: UInt8[np.ndarray, " P"], label: UInt8[np.ndarray, " P"]
    ) -> UInt8[np.ndarray, "P 3"]:
        """Return the colours of points on the T-pose, with the part and the label of each."""
        joints = self.body.joint_regressor @ self.tpose.vertices[: self.body.vertex_count]
        joint = dict(zip(self.body.joint_names, joints, strict=True))
        out = np.zeros((len(points), 3))
        left = points[:, 0] > 0
        eye = np.where(left[:, None], joint["left_eye_smplhf"], joint["right_eye_smplhf"])
        for k, name in enumerate(PART_NAMES):
            own = part == k
            if name == "body":
                out[own] = textures.skin_colors(points[own], self.face, seed=1)
                own &= (label == _OTHER) & (np.linalg.norm(points - eye, axis=1) < 0.02)
                out[own] = textures.eye_colors(points[own] - eye[own])
            elif name == "upper":
                out[own] = textures.shirt_colors(points[own], joint["left_shoulder"])
            elif name == "lower":
                if self.clothes == "skirt":
                    out[own] = skirt_colors(points[own], joint["pelvis"][2], self.skirt_pattern)
                else:
                    out[own] = textures.trouser_colors(points[own], joint["left_hip"], joint["left_ankle"])
            elif name == "shoes":
                out[own] = textures.shoe_colors(points[own], self.tpose.vertices[:, 1].min())
            else:
                out[own] = textures.hair_colors(points[own], seed=2)
        return np.clip(out, 0, 255).astype(np.uint8)


def face_marks(landmarks: Float[np.ndarray, "51 3"]) -> textures.FaceMarks:
    """Pick what is painted from landmarks in dlib's order from 17."""
    return textures.FaceMarks(brows=landmarks[:10], eyes=landmarks[19:31], lips=landmarks[31:43])
