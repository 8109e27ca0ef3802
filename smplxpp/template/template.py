"""Template: the naked body and its clothes as one skinned mesh in the T-pose (SMPLX++)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.core.labels import CLOTH_LABELS, LABELS, semantic_colors
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.skin_weights import SkinWeights

if TYPE_CHECKING:
    from smplxpp.body.model import BodyModel, PosedBody

# The name of the part that comes first.
BODY_PART = "body"
# How the arrays are kept; bases in float32, which is what model files hold.
_DTYPES = {
    "vertices": np.float64,
    "faces": np.int64,
    "vertex_labels": np.int32,
    "vertex_part": np.int32,
    "vertex_colors": np.uint8,
    "joint_regressor": np.float64,
    "parents": np.int64,
    "betas": np.float64,
    "shape_basis": np.float32,
    "expression_basis": np.float32,
    "pose_basis": np.float32,
    "left_hand_components": np.float64,
    "right_hand_components": np.float64,
    "left_hand_mean": np.float64,
    "right_hand_mean": np.float64,
    "body_labels": np.int64,
    "body_index": np.int64,
    "scan_index": np.int64,
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Template:
    """A personalised clothed body: V vertices of which the first Vb are the body's in its own order, then the parts'.

    The identity (`betas`) is in the vertices; expression and pose are neutral. The body keeps its shape, expression and
    pose-corrective bases; parts follow the joints alone.

    Attributes:
        vertices: (V, 3) float64 T-pose, metres.
        faces: (F, 3) int64; the body's first, then each part's, no face across parts.
        vertex_labels: (V,) int32 ids of `smplxpp.core.labels`; skin on the body.
        vertex_part: (V,) int32 index into `part_names`, increasing.
        part_names: "body", then the parts.
        vertex_colors: (V, 3) uint8 sRGB as scanned.
        weights: of all V vertices over J joints.
        joint_regressor: (J, Vb) float64: rest joints of the body's vertices.
        parents: (J,) int64, -1 at the root. joint_names: J names.
        betas: (B',) the identity, B' <= B.
        shape_basis: (Vb, 3, B) float32 metres a unit of beta.
        expression_basis: (Vb, 3, E) float32 metres a unit; E may be 0.
        pose_basis: (Vb, 3, 9 (J - 1)) float32 pose correctives, or None.
        left_hand_components, right_hand_components: (K, 45) or None. left_hand_mean, right_hand_mean: (45,) or None.
        body_labels: (Vb,) int64 index into `body_label_names`: anatomical parts of the body's file.
        body_label_names: their names.
        body_index: (V,) int64 the nearest body vertex at rest; its own index for a body vertex.
        scan_index: (V,) int64 vertex of the scan that a vertex comes from, or -1.
        expression_names: E names; numbered where none are given.
        metadata: short texts: name of the body, versions.

    Raises:
        InputError: arrays that do not fit each other.
    """

    vertices: np.ndarray
    faces: np.ndarray
    vertex_labels: np.ndarray
    vertex_part: np.ndarray
    part_names: tuple[str, ...]
    vertex_colors: np.ndarray
    weights: SkinWeights
    joint_regressor: np.ndarray
    parents: np.ndarray
    joint_names: tuple[str, ...]
    betas: np.ndarray
    shape_basis: np.ndarray
    expression_basis: np.ndarray
    pose_basis: np.ndarray | None
    left_hand_components: np.ndarray | None
    right_hand_components: np.ndarray | None
    left_hand_mean: np.ndarray | None
    right_hand_mean: np.ndarray | None
    body_labels: np.ndarray
    body_label_names: tuple[str, ...]
    body_index: np.ndarray
    scan_index: np.ndarray
    expression_names: tuple[str, ...] = ()
    metadata: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, dtype in _DTYPES.items():
            value = getattr(self, name)
            if value is not None:
                value = np.array(value, dtype=dtype, order="C")
                value.setflags(write=False)
                object.__setattr__(self, name, value)
        for name in ("part_names", "joint_names", "body_label_names", "expression_names"):
            object.__setattr__(self, name, tuple(map(str, getattr(self, name))))
        if len(self.expression_names) != self.expression_basis.shape[-1]:
            numbered = tuple(f"expression_{k:02d}" for k in range(self.expression_basis.shape[-1]))
            object.__setattr__(self, "expression_names", numbered)
        self._check()

    def _check(self) -> None:
        V, J = len(self.vertices), len(self.parents)
        Vb = self.joint_regressor.shape[-1]
        shapes = {
            "vertices": (V, 3),
            "faces": (len(self.faces), 3),
            "vertex_labels": (V,),
            "vertex_part": (V,),
            "vertex_colors": (V, 3),
            "joint_regressor": (J, Vb),
            "parents": (J,),
            "betas": (len(self.betas),),
            "shape_basis": (Vb, 3, None),
            "expression_basis": (Vb, 3, None),
            "pose_basis": (Vb, 3, 9 * (J - 1)),
            "body_labels": (Vb,),
            "body_index": (V,),
            "scan_index": (V,),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            fits = value.ndim == len(shape) and all(b in (None, a) for a, b in zip(value.shape, shape, strict=True))
            _require(fits, name, f"shape {shape}", f"shape {value.shape}")
            _require(bool(np.isfinite(value).all()), name, "finite values", "NaN or infinity")
        _require(Vb <= V, "vertices", f"at least the body's {Vb}", str(V))
        for name, bound in {
            "faces": V,
            "vertex_part": len(self.part_names),
            "body_labels": len(self.body_label_names),
            "body_index": Vb,
            "vertex_labels": len(LABELS),
        }.items():
            value = getattr(self, name)
            inside = not value.size or (value.min() >= 0 and value.max() < bound)
            _require(inside, name, f"indices in [0, {bound})", "others")
        _require(
            len(self.weights) == V and self.weights.joint_count == J,
            "weights",
            f"{V} vertices over {J} joints",
            f"{len(self.weights)} over {self.weights.joint_count}",
        )
        _require(len(self.joint_names) == J, "joint_names", f"{J} names", str(len(self.joint_names)))
        _require(
            self.part_names[:1] == (BODY_PART,) and len(set(self.part_names)) == len(self.part_names),
            "part_names",
            f"distinct names, {BODY_PART!r} first",
            str(self.part_names),
        )
        body_first = bool((self.vertex_part[:Vb] == 0).all() and (np.diff(self.vertex_part[Vb:], prepend=1) >= 0).all())
        _require(body_first, "vertex_part", f"0 for the body's {Vb} vertices, then increasing", "another order")
        crossing = (self.vertex_part[self.faces] != self.vertex_part[self.faces[:, :1]]).any()
        _require(not crossing, "faces", "corners within one part", "faces across parts")

    @property
    def vertex_count(self) -> int:
        return len(self.vertices)

    @property
    def body_vertex_count(self) -> int:
        return self.joint_regressor.shape[1]

    @property
    def joint_count(self) -> int:
        return len(self.parents)

    @cached_property
    def joints(self) -> np.ndarray:
        """(J, 3) rest joints, metres."""
        return self.joint_regressor @ self.vertices[: self.body_vertex_count]

    @cached_property
    def mesh(self) -> TriangleMesh:
        """Body and parts in the T-pose."""
        return TriangleMesh(self.vertices, self.faces)

    @property
    def cloth_mask(self) -> np.ndarray:
        """(V,) bool, vertices of clothes: upper, lower, outer."""
        return np.isin(self.vertex_labels, [label.id for label in CLOTH_LABELS])

    @property
    def semantic_colors(self) -> np.ndarray:
        """(V, 3) uint8 colours of the labels that a trainer sees."""
        return semantic_colors(self.vertex_labels)

    def part_faces(self, name: str) -> np.ndarray:
        """(F,) bool, the faces of a part.

        Raises:
            InputError: no such part.
        """
        if name not in self.part_names:
            raise InputError("part", expected=f"one of {', '.join(self.part_names)}", received=repr(name))
        return self.vertex_part[self.faces[:, 0]] == self.part_names.index(name)

    def part_mesh(self, name: str) -> TriangleMesh:
        """A part alone, its vertices in order, those without a face dropped."""
        return self.mesh.submesh(self.part_faces(name))[0]

    def naked(self) -> Template:
        """The body without its parts: the same person undressed, as a template of its own."""
        count = self.body_vertex_count
        own = ("vertices", "vertex_labels", "vertex_part", "vertex_colors", "body_index", "scan_index")
        per_vertex = ("joint_indices", "joint_weights", "matched", "distance", "angle", "component")
        weights = replace(self.weights, **{name: getattr(self.weights, name)[:count] for name in per_vertex})
        return replace(
            self,
            **{name: getattr(self, name)[:count] for name in own},
            faces=self.faces[self.part_faces(BODY_PART)],
            part_names=(BODY_PART,),
            weights=weights,
        )

    @cached_property
    def body_model(self) -> BodyModel:
        """The naked body of this identity: its mean shape is the template's, so betas given to it are changes."""
        # The body's package builds on core; only a template that is posed reaches up to it, for the one skinning.
        from smplxpp.body.model import BodyModel

        count = self.body_vertex_count
        return BodyModel(
            name=self.metadata.get("body", "template"),
            v_template=self.vertices[:count],
            faces=self.faces[self.part_faces(BODY_PART)],
            shapedirs=self.shape_basis.astype(np.float64),
            exprdirs=self.expression_basis.astype(np.float64),
            posedirs=None if self.pose_basis is None else self.pose_basis.astype(np.float64),
            joint_regressor=self.joint_regressor,
            parents=self.parents,
            joint_names=self.joint_names,
            weights=self._dense_weights[:count],
            left_hand_components=self.left_hand_components,
            right_hand_components=self.right_hand_components,
            left_hand_mean=self.left_hand_mean,
            right_hand_mean=self.right_hand_mean,
            part_labels=self.body_labels,
            part_label_names=self.body_label_names,
            expression_names=self.expression_names,
        )

    @cached_property
    def _dense_weights(self) -> np.ndarray:
        return self.weights.dense()

    def pose(self, params: BodyParams) -> np.ndarray:
        """The template in T poses.

        The body takes expression and pose correctives as its model does, `x = sum_j w_j G_j (v + E psi + P vec(R - I))
        + t`; the parts are skinned with the same G. The identity is the template's own: the betas in `params` are not
        looked at.

        Args:
            params: T frames.

        Returns:
            (T, V, 3) metres.

        Raises:
            InputError: parameters that the body model refuses.
        """
        from smplxpp.skinning.linear_blend import skin

        posed = self.posed_body(params)
        count = self.body_vertex_count
        parts = skin(self.vertices[count:], self._dense_weights[count:], posed.posed_from_rest)
        return np.concatenate([posed.vertices, parts], axis=1)

    def posed_from_rest(self, params: BodyParams) -> np.ndarray:
        """(T, J, 4, 4) transforms of the joints in T poses, as `pose` applies them."""
        return self.posed_body(params).posed_from_rest

    def posed_body(self, params: BodyParams) -> PosedBody:
        """The naked body of this identity in T poses: what `pose` skins the parts with."""
        return self.body_model.forward(replace(params, betas=np.zeros((len(params), 0))))

    def save(self, path: str | Path) -> None:
        """Write an npz without pickled objects, whole or not at all; the same template gives the same bytes."""
        from smplxpp.template.template_file import save_template

        save_template(self, path)

    @staticmethod
    def load(path: str | Path) -> Template:
        """Read what `save` wrote, bit for bit.

        Raises:
            InputError: missing, damaged or foreign file, or one of a newer version.
        """
        from smplxpp.template.template_file import load_template

        return load_template(path)


def _require(condition: bool, subject: str, expected: str, received: str) -> None:
    if not condition:
        raise InputError(f"template: {subject}", expected=expected, received=received)
