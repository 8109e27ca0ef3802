"""Template: the naked body and its clothes as one skinned mesh in the T-pose (SMPLX++)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64, UInt8

from smplxpp.body.model import BodyModel, PosedBody
from smplxpp.core import (
    LABELS,
    BodyParams,
    InputError,
    Label,
    Labels,
    SkinWeights,
    TriangleMesh,
    require_choice,
)
from smplxpp.core.files.array_file import read_arrays, write_arrays
from smplxpp.skinning.linear_blend import skin
from smplxpp.template import template_arrays
from smplxpp.template.template_arrays import check_arrays, metadata_of
from smplxpp.template.texture import Texture, texture_arrays, texture_from_arrays

# The name of the part that comes first.
BODY_PART = "body"
_BUILD_AGAIN = "the file is damaged or no template: build it again"
# How the template's own arrays are kept, and in its file.
_DTYPES = {
    "vertices": np.float64,
    "faces": np.int64,
    "vertex_labels": np.int32,
    "vertex_part": np.int32,
    "vertex_colors": np.uint8,
    "betas": np.float64,
    "body_index": np.int64,
    "scan_index": np.int64,
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Template:
    """A personalised clothed body: V vertices of which the first Vb are the body's in its own order, then the parts'.

    The identity (`betas`) is in the vertices; expression and pose are neutral. The body keeps its shape, expression and
    pose-corrective bases; parts follow the joints alone.

    Attributes:
        body: the naked body of this identity over J joints: its mean shape is the template's, so betas given to it are
            changes. Its mean shape, faces and weights are taken from the first part when the template is made,
            whatever the model given held there; its bases are rounded to float32, the precision of the file.
        vertices: T-pose, metres.
        faces: the body's first, then each part's, no face across parts.
        vertex_labels: ids of `labels`; skin on the body.
        vertex_part: index into `part_names`, increasing.
        part_names: "body", then the parts.
        vertex_colors: sRGB as scanned.
        weights: of all V vertices over J joints.
        betas: the identity, B' <= B.
        body_index: the nearest body vertex at rest; its own index for a body vertex.
        scan_index: vertex of the scan that a vertex comes from, or -1.
        metadata: short texts: name of the body, versions.
        labels: the semantic classes, the built-in ones or with a user's own.
        texture: pictures of the surface; None: the colours of the vertices are all there is.

    Raises:
        InputError: arrays that do not fit each other.

    Example:
        >>> template = smplxpp.Template.load("anna.npz")  # doctest: +SKIP
        >>> template.pose(smplxpp.load_params("walk.npz")).shape  # doctest: +SKIP
        (120, 24400, 3)
        >>> template.export("anna.usdc")  # doctest: +SKIP
    """

    body: BodyModel
    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    vertex_labels: Int32[np.ndarray, " V"]
    vertex_part: Int32[np.ndarray, " V"]
    part_names: tuple[str, ...]
    vertex_colors: UInt8[np.ndarray, "V 3"]
    weights: SkinWeights
    betas: Float64[np.ndarray, " B"]
    body_index: Int64[np.ndarray, " V"]
    scan_index: Int64[np.ndarray, " V"]
    metadata: dict[str, str] = field(default_factory=dict)
    labels: Labels = LABELS
    texture: Texture | None = None

    def __post_init__(self) -> None:
        for name, dtype in _DTYPES.items():
            object.__setattr__(self, name, template_arrays.read_only(getattr(self, name), dtype))
        object.__setattr__(self, "part_names", tuple(map(str, self.part_names)))
        self._check()
        count = self.body.vertex_count
        body = template_arrays.completed_body(
            self.body,
            vertices=self.vertices[:count],
            faces=self.faces[self.part_faces(BODY_PART)],
            weights=self._dense_weights[:count],
        )
        object.__setattr__(self, "body", body)

    def __repr__(self) -> str:
        parts = ", ".join(self.part_names)
        return f"Template({len(self.vertices):,} vertices, {len(self.faces):,} faces; {parts})"

    def _check(self) -> None:
        V, J, Vb = len(self.vertices), self.body.joint_count, self.body.vertex_count
        # Every array must have the shape that the number of vertices demands, and no NaN.
        shapes = {
            "vertices": (V, 3),
            "faces": (len(self.faces), 3),
            "vertex_labels": (V,),
            "vertex_part": (V,),
            "vertex_colors": (V, 3),
            "betas": (len(self.betas),),
            "body_index": (V,),
            "scan_index": (V,),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            _require(value.shape == shape, name, f"shape {shape}", f"shape {value.shape}")
            _require(bool(np.isfinite(value).all()), name, "finite values", "NaN or infinity")
        # The body model has checked the shapes of its own arrays; what remains is that they are finite.
        for name in template_arrays.BODY_KEYS:
            value = getattr(self.body, name)
            if isinstance(value, np.ndarray):
                _require(bool(np.isfinite(value).all()), f"body.{name}", "finite values", "NaN or infinity")
        # The template's vertices begin with the body's; indices must lie inside what they point into.
        _require(Vb <= V, "vertices", f"at least the body's {Vb}", str(V))
        for name, bound in {
            "faces": V,
            "vertex_part": len(self.part_names),
            "body_index": Vb,
            "vertex_labels": len(self.labels),
        }.items():
            value = getattr(self, name)
            inside = not value.size or (value.min() >= 0 and value.max() < bound)
            _require(inside, name, f"indices in [0, {bound})", "others")
        # One row of skinning weights for each vertex, over the body's joints.
        _require(
            len(self.weights) == V and self.weights.joint_count == J,
            "weights",
            f"{V} vertices over {J} joints",
            f"{len(self.weights)} over {self.weights.joint_count}",
        )
        _require(
            self.part_names[:1] == (BODY_PART,) and len(set(self.part_names)) == len(self.part_names),
            "part_names",
            f"distinct names, {BODY_PART!r} first",
            str(self.part_names),
        )
        # Parts are contiguous ranges in order, the body first, so that a part is a slice of the vertices; no face joins
        # two.
        body_first = bool((self.vertex_part[:Vb] == 0).all() and (np.diff(self.vertex_part[Vb:], prepend=1) >= 0).all())
        _require(body_first, "vertex_part", f"0 for the body's {Vb} vertices, then increasing", "another order")
        crossing = (self.vertex_part[self.faces] != self.vertex_part[self.faces[:, :1]]).any()
        _require(not crossing, "faces", "corners within one part", "faces across parts")
        if self.texture is not None:
            found = (len(self.texture.face_uv), len(self.texture.picture))
            wanted = (len(self.faces), len(self.part_names))
            _require(found == wanted, "texture", "as many faces and parts: {}, {}".format(*wanted), str(found))

    @property
    def vertex_count(self) -> int:
        return len(self.vertices)

    @cached_property
    def joints(self) -> Float64[np.ndarray, "J 3"]:
        """Return the joints of the rest pose, metres."""
        return self.body.joint_regressor @ self.body.v_template

    @cached_property
    def mesh(self) -> TriangleMesh:
        """Body and parts in the T-pose."""
        return TriangleMesh(self.vertices, self.faces)

    @property
    def cloth_mask(self) -> Bool[np.ndarray, " V"]:
        """The vertices of clothes: upper, lower, outer, and what behaves like them."""
        return np.isin(self.vertex_labels, [label.id for label in self.labels.cloth])

    def label_of(self, part: str) -> Label:
        """Return the commonest label of a part.

        Raises:
            InputError: no such part.
        """
        require_choice("part", part, self.part_names)
        own = self.vertex_labels[self.vertex_part == self.part_names.index(part)]
        return self.labels[int(np.bincount(own, minlength=1).argmax())]

    @property
    def cloth_parts(self) -> tuple[str, ...]:
        """The parts that are clothes, in the order of their labels."""
        clothes = (label.name for label in self.labels.cloth)
        return tuple(name for name in clothes if name in self.part_names)

    @property
    def loose_parts(self) -> tuple[str, ...]:
        """The parts that are clothes and hang freely as far as their labels say: neither tight nor rigid."""
        rigid = {label.name for label in self.labels if label.tight or label.stiff}
        return tuple(name for name in self.cloth_parts if name not in rigid)

    @property
    def semantic_colors(self) -> UInt8[np.ndarray, "V 3"]:
        """The sRGB colours of the labels that a trainer sees."""
        return self.labels.semantic_colors(self.vertex_labels)

    def part_faces(self, name: str) -> Bool[np.ndarray, " F"]:
        """Return the faces of one part of the template.

        Raises:
            InputError: no such part.
        """
        require_choice("part", name, self.part_names)
        return self.vertex_part[self.faces[:, 0]] == self.part_names.index(name)

    def part_mesh(self, name: str) -> TriangleMesh:
        """A part alone, its vertices in order, those without a face dropped."""
        return self.mesh.submesh(self.part_faces(name))[0]

    def naked(self) -> Template:
        """The body without its parts: the same person undressed, as a template of its own."""
        count = self.body.vertex_count
        own = ("vertices", "vertex_labels", "vertex_part", "vertex_colors", "body_index", "scan_index")
        per_vertex = ("joint_indices", "joint_weights", "matched", "distance", "angle", "component")
        weights = replace(self.weights, **{name: getattr(self.weights, name)[:count] for name in per_vertex})
        kept = self.part_faces(BODY_PART)
        return replace(
            self,
            **{name: getattr(self, name)[:count] for name in own},
            faces=self.faces[kept],
            texture=None if self.texture is None else self.texture.of_faces(kept, 1),
            part_names=(BODY_PART,),
            weights=weights,
        )

    def on_floor(self) -> Template:
        """Return the same person with the soles of the T-pose at y = 0, where other programs expect a standing figure.

        The template itself keeps the body model's frame, whose origin lies near the pelvis: parameters refer to it.
        Vertices and rest joints move by the same height, so that every pose does, too.

        Example:
            >>> float(abs(template.on_floor().vertices[:, 1].min()))
            0.0
        """
        # Vertices without a face, such as the body's below shoes, do not stand on the floor.
        lift = np.array([0.0, -float(self.vertices[np.unique(self.faces), 1].min()), 0.0])
        body = replace(self.body, v_template=self.body.v_template + lift)
        return replace(self, vertices=self.vertices + lift, body=body)

    @cached_property
    def _dense_weights(self) -> Float64[np.ndarray, "V J"]:
        return self.weights.dense()

    def pose(self, params: BodyParams) -> Float64[np.ndarray, "T V 3"]:
        """Return the vertices of the template in T poses.

        The body takes expression and pose correctives as its model does, `x = sum_j w_j G_j (v + E psi + P vec(R - I))
        + t`; the parts are skinned with the same G. The identity is the template's own: the betas in `params` are not
        looked at.

        Args:
            params: T frames.

        Returns:
            Metres.

        Raises:
            InputError: parameters that the body model refuses.
        """
        posed = self.posed_body(params)
        count = self.body.vertex_count
        parts = skin(self.vertices[count:], self._dense_weights[count:], posed.posed_from_rest)
        return np.concatenate([posed.vertices, parts], axis=1)

    def posed_from_rest(self, params: BodyParams) -> Float64[np.ndarray, "T J 4 4"]:
        """Transforms of the joints in T poses, as `pose` applies them."""
        return self.posed_body(params).posed_from_rest

    def posed_body(self, params: BodyParams) -> PosedBody:
        """The naked body of this identity in T poses: what `pose` skins the parts with."""
        return self.body.forward(params.without_shape())

    def save(self, path: str | Path) -> None:
        """Write an npz without pickled objects, whole or not at all; the same template gives the same bytes."""
        arrays = {name: getattr(self, name) for name in _DTYPES}
        arrays |= template_arrays.body_arrays(self.body) | template_arrays.weight_arrays(self.weights)
        arrays |= {
            template_arrays.SCHEMA_KEY: np.asarray(np.int64(template_arrays.SCHEMA)),
            "part_names": template_arrays.plain_array(self.part_names),
            "metadata": np.array(json.dumps(self.metadata, sort_keys=True)),
        }
        # Templates with the built-in labels are read by versions that know no others.
        if self.labels != LABELS:
            arrays["labels"] = np.array(json.dumps(self.labels.as_list()))
        pictures = {} if self.texture is None else texture_arrays(self.texture)
        write_arrays(path, template_arrays.in_file_order(arrays) | pictures)

    def export(
        self, path: str | Path, *, animation: BodyParams | None = None, faces: int | None = None, **options: Any
    ) -> Path:
        """Write the template in a format of other programs, chosen by the path's suffix.

        `.glb` (skin, expressions, colours, motion), `.fbx` (the same, by Blender), `.usd`, `.usda`, `.usdc` or `.usdz`
        (the same, by usd-core), `.vrm` (VRM 1.0, without motion), `.obj` (the surface in the T-pose, or in the one pose
        of `animation`), `.npz` (as `save`, for `load`).

        Args:
            path: of the file.
            animation: T frames that the file plays; None: the template alone.
            faces: of a coarser level of detail, by `smplxpp.build.detail.simplified_template`; None: all.
            options: of rigged files, the fields of `smplxpp.export.by_suffix.ExportOptions`: `joint_names`,
                `max_influences`, `blender`, `meta`.

        Returns:
            The path.

        Raises:
            InputError: another suffix, frames or options that the format cannot hold, FBX without Blender.
            MissingExtraError: USD without usd-core.

        Example:
            >>> template.export("anna.glb", joint_names="unity", max_influences=4)  # doctest: +SKIP
        """
        # Writers lie above this room; they are imported when they are called, by name.
        writers = import_module("smplxpp.export.by_suffix")
        asked = writers.ExportOptions(**options)
        detail = self if faces is None else import_module("smplxpp.build.detail").simplified_template(self, faces)
        return writers.export_template(path, detail, animation=animation, options=asked)

    @staticmethod
    def load(path: str | Path) -> Template:
        """Read what `save` wrote, bit for bit.

        Raises:
            InputError: missing, damaged or foreign file, or one of a newer version.
        """
        arrays = read_arrays(path, subject="template file", remedy=_BUILD_AGAIN)
        schema = arrays.pop(template_arrays.SCHEMA_KEY, None)
        if schema is None:
            raise InputError(
                f"template file {path}",
                expected="a file written by Template.save",
                received=f"an npz with keys {sorted(arrays)[:6]}",
            )
        version = schema.item() if schema.shape == () and schema.dtype.kind in "iu" else 0
        if not 1 <= version <= template_arrays.SCHEMA:
            raise InputError(
                f"template file {path}",
                expected=f"a file of version {template_arrays.SCHEMA} or older",
                received=f"version {version}" if version else f"{schema.dtype} of shape {schema.shape}",
                remedy="update smplxpp" if version > template_arrays.SCHEMA else _BUILD_AGAIN,
            )
        try:
            return _from_arrays(arrays)
        except InputError as error:
            raise InputError(
                f"template file {path}: {error.subject.removeprefix('template: ')}",
                expected=error.expected,
                received=error.received,
                remedy=error.remedy or _BUILD_AGAIN,
            ) from None


def _from_arrays(arrays: Mapping[str, np.ndarray]) -> Template:
    check_arrays(arrays)
    metadata = metadata_of(arrays)
    return Template(
        body=template_arrays.body_from_arrays(arrays, name=metadata.get("body", "template")),
        weights=template_arrays.weights_from_arrays(arrays),
        part_names=tuple(map(str, arrays["part_names"])),
        metadata=metadata,
        vertices=arrays["vertices"],
        faces=arrays["faces"],
        vertex_labels=arrays["vertex_labels"],
        vertex_part=arrays["vertex_part"],
        vertex_colors=arrays["vertex_colors"],
        betas=arrays["betas"],
        body_index=arrays["body_index"],
        scan_index=arrays["scan_index"],
        labels=template_arrays.labels_of(arrays),
        texture=texture_from_arrays(arrays),
    )


def _require(condition: bool, subject: str, expected: str, received: str) -> None:
    if not condition:
        raise InputError(f"template: {subject}", expected=expected, received=received)
