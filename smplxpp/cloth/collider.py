"""What a garment may touch: the body near it and the clothes that lie under it, coarse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64
from scipy.spatial import cKDTree

from smplxpp.cloth.cloth_mesh import coarsen
from smplxpp.cloth.solver import Collider
from smplxpp.core.labels import HAIR
from smplxpp.core.mesh import TriangleMesh
from smplxpp.template.template import BODY_PART, Template

if TYPE_CHECKING:
    from smplxpp.cloth.garment import GarmentConfig

# Metres from the garment at rest: other skin is not looked at, unless cloth that hangs free comes there.
NEAR = 0.3
# Metres behind a surface up to which cloth is pushed out of it: half a limb, little of a sheet.
SOLID_DEPTH, SHEET_DEPTH = 0.05, 0.02
# Joints whose skin is too small for the collider's spacing; hair takes the head.
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")
_FACE = ("head", "jaw", "eye")


@dataclass(frozen=True, eq=False)
class ColliderMesh:
    """Vertices of the template that stand for surfaces.

    Attributes:
        vertices: of the template.
        faces: of indices into them.
        margin, deepest: see `Collider`.
    """

    vertices: Int64[np.ndarray, " c"]
    faces: Int32[np.ndarray, "d 3"]
    margin: Float32[np.ndarray, " c"]
    deepest: Float32[np.ndarray, " c"]

    @property
    def native(self) -> Collider:
        """Return the collider as arrays for the solver."""
        return Collider(self.faces, self.margin, self.deepest)


def collider_of(
    template: Template, part: str, posed: TriangleMesh, config: GarmentConfig, *, hangs: float
) -> ColliderMesh:
    """Choose what a part may touch: skin without head and fingers, and the parts whose layer lies under its own.

    Args:
        posed: the template in the pose that the part was scanned in.
        hangs: metres along the cloth from what carries it to the hem, the most.
    """
    # Only surfaces near the part at rest can touch it; this keeps the collider small. Cloth that hangs from a waist
    # comes to all skin below it within its own length: who squats puts shins and feet into a skirt that ended 40 cm
    # above them, and where a foot is not seen to be there, the cloth slides over the whole leg. Not where loose clothes
    # lie over each other: a foot that kicks the inner one drives it through the outer one between two searches for
    # contacts.
    hangs = 0.0 if set(template.loose_parts) - {part} else hangs
    own = posed.vertices[np.unique(template.faces[template.part_faces(part)])]
    away = cKDTree(own).query(posed.vertices, distance_upper_bound=max(NEAR, hangs))[0]
    near = (away < NEAR) | ((away < hangs) & (posed.vertices[:, 1] < own[:, 1].min()))
    # Fingers and the face are too fine for the collider's spacing; only hair collides with the head.
    hair = template.label_of(part).kind == HAIR.name
    usable = near & ~_small_skin(template, head=hair)
    vertices, faces, margin, deepest, start = [], [], [], [], 0
    for name in (BODY_PART, *_layers_under(template, part)):
        chosen = template.part_faces(name) & usable[template.faces].all(axis=1)
        if not chosen.any():
            continue
        # Coarsen each surface on its own: particles are as sparse, and contact costs grow with the number of faces.
        mesh, index = posed.submesh(chosen)
        seeds, triangles = coarsen(mesh, config.collider_spacing)
        # The body is solid, so cloth is pushed out from as deep as half a limb. A sheet has two sides:
        # cloth a little deeper is taken to lie on the other one.
        solid = name == BODY_PART
        vertices.append(index[seeds])
        faces.append(triangles + start)
        margin.append(np.full(len(seeds), config.skin_margin if solid else config.sheet_margin))
        deepest.append(np.full(len(seeds), SOLID_DEPTH if solid else SHEET_DEPTH))
        start += len(seeds)
    # A part that floats free of everything gets an empty collider of the right types.
    if not vertices:
        return ColliderMesh(
            np.zeros(0, np.int64), np.zeros((0, 3), np.int32), np.zeros(0, np.float32), np.zeros(0, np.float32)
        )
    return ColliderMesh(
        np.concatenate(vertices),
        np.concatenate(faces).astype(np.int32),
        np.concatenate(margin).astype(np.float32),
        np.concatenate(deepest).astype(np.float32),
    )


def _layers_under(template: Template, part: str) -> list[str]:
    """The parts that lie under a part, the innermost first."""
    order = {label: place for place, label in enumerate(template.labels.layer_order)}
    names = {label.name: label for label in template.labels}

    def place(name: str) -> int:
        label = names.get(name)
        return order.get(label.id, 0) if label else 0

    # A thing in a hand is no layer: it may lie against cloth on either side.
    things = [label.name for label in template.labels if label.layer is None]
    others = [name for name in template.part_names if name not in (BODY_PART, *things, part)]
    return sorted((name for name in others if place(name) < place(part)), key=place)


def head_skin(template: Template) -> Bool[np.ndarray, " V"]:
    """Return the vertices of the body that follow the head."""
    out = np.zeros(template.vertex_count, dtype=bool)
    out[: template.body.vertex_count] = _follows(template, _FACE)
    return out


def _follows(template: Template, words: tuple[str, ...]) -> np.ndarray:
    """The vertices of the body that follow most a joint with one of the words in its name."""
    body = template.body
    strongest = np.asarray(template.weights.dense()[: body.vertex_count].argmax(axis=1))
    return np.array([any(word in name for word in words) for name in body.joint_names])[strongest]


def _small_skin(template: Template, *, head: bool) -> np.ndarray:
    """(V,) the vertices of the body that follow the head or a finger, or that lie inside it, as eyes do."""
    body = template.body
    small = _follows(template, _FINGERS if head else (*_FINGERS, *_FACE))
    if BODY_PART in body.part_label_names:  # a body whose file names eyes and teeth apart
        small |= body.part_labels != body.part_label_names.index(BODY_PART)
    out = np.zeros(template.vertex_count, dtype=bool)
    out[: body.vertex_count] = small
    return out
