"""Write a trained student as a bundle for players: only what driving needs, quantised to the visible precision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from avatar.export.bare_skin import bare_skin
from avatar.export.bundle_numbers import Tensors, blended, halves, rounded, signed, unsigned, usual_coefficients
from avatar.gaussians import BoundGaussians
from avatar.models.networks.blend_shapes import BlendShapes
from avatar.models.networks.pose_dependence import BODY_JOINTS
from avatar.models.student import Student
from avatar.runtime.bundle import GARMENTS, MOTION, AboutAvatar, motion_tensors, save_bundle
from smplxpp.cloth.driver import DriverConfig
from smplxpp.cloth.garment import Garment
from smplxpp.cloth.garment_file import garments_to_arrays
from smplxpp.core import BodyParams, require_positive
from smplxpp.template.template import Template


@dataclass(frozen=True, kw_only=True)
class BundleConfig:
    """Quantisation of the numbers of a bundle.

    Attributes:
        exact: store float32 throughout; else halves and integers as follows.
        position_step: step of a blend shape's position times its usual coefficient, metres.
        color_step: step of a blend shape's colour times its usual coefficient, sRGB in [0, 1].
        basis_step: step of the body's expressions and pose correctives, metres.
    """

    exact: bool = False
    position_step: float = 5e-5
    color_step: float = 1e-3
    basis_step: float = 2e-5

    def __post_init__(self) -> None:
        for name in ("position_step", "color_step", "basis_step"):
            require_positive(f"bundle: {name}", getattr(self, name))

    @property
    def reductions(self) -> dict[str, str]:
        """The quantisation of each piece, in words."""
        if self.exact:
            return {"all": "float32"}
        return {
            "surface": "vertices float32, skin weights 16 bits, expressions and pose correctives 8 bits where they "
            f"move a vertex by more than {500 * self.basis_step:g} mm",
            "field": "float16, interpolation 8 bits",
            "regression": "float16, angles float32",
            "gaussians": "float16; barycentric coordinates and opacities 16 bits, rotations and harmonics 8",
            "blend": f"8 bits in steps of {1000 * self.position_step:g} mm and {self.color_step:g}, without what a "
            "gate closes, networks float16",
        }


@dataclass(frozen=True, kw_only=True)
class BundleExtras:
    """Content of a bundle beside the student.

    Attributes:
        name: see `AboutAvatar`.
        licence: see `AboutAvatar`.
        provenance: see `AboutAvatar`.
        garments: the loose clothes.
        cloth: how players step these.
        motion: to play; None: none is stored.
    """

    name: str
    licence: str = ""
    provenance: Mapping[str, str] = field(default_factory=dict)
    garments: Sequence[Garment] = ()
    cloth: DriverConfig = field(default_factory=DriverConfig)
    motion: BodyParams | None = None


def write_bundle(
    path: str | Path, student: Student, extras: BundleExtras, config: BundleConfig | None = None
) -> dict[str, int]:
    """Write a student as a bundle; a failed write leaves no file.

    Returns:
        Bytes of each piece in the file, and "total".
    """
    config = config or BundleConfig()
    template = student.rig.template
    # Sort the Gaussians by their face: a player then needs the number on each face instead of an index for each
    # Gaussian. The sort is stable, so that the order within a face is reproducible.
    bound = student.gaussians.snapshot()
    order = torch.argsort(bound.face_index, stable=True)
    bound = bound.select(order)
    faces, per_face = np.unique(bound.face_index.numpy(), return_counts=True)
    # Keep only the vertices and faces that carry Gaussians or that garments need.
    cut = _Cut.of(template, faces, extras.garments)
    pieces: dict[str, tuple[Tensors, Mapping[str, Any]]] = {
        "skeleton": (_skeleton(template), {}),
        "surface": (_surface(template, cut, config), {}),
        "gaussians": (_gaussians(bound.tensors, per_face, config) | _bare(template, bound, config), {}),
    }
    # Optional pieces follow the parts that the student was trained with.
    if student.field is not None and student.codes is not None:
        pieces["field"] = (_field(student, cut, config), {})
    if student.regression is not None:
        pieces["regression"] = (_regression(student, cut, config), {})
    if student.blend_shapes is not None:
        usual = usual_coefficients(student, extras.motion)
        pieces["blend"] = (_blend(student.blend_shapes, order, usual, config), {})
    if student.pose_gate is not None:
        known = {"known": student.pose_gate.poses, "scale": student.pose_gate.scale}
        pieces["poses"] = ({name: value.cpu().numpy() for name, value in known.items()}, {})
    if extras.garments:
        pieces[GARMENTS] = _garments(extras, cut)
    if extras.motion is not None:
        pieces[MOTION] = (motion_tensors(extras.motion), {})
    # The header describes the avatar, so that a player can name joints and expressions without the template.
    codes = student.codes
    about = AboutAvatar(
        name=extras.name,
        licence=extras.licence,
        provenance=extras.provenance,
        joint_names=template.body.joint_names,
        expression_names=template.body.expression_names,
        part_names=template.part_names,
        frames=student.frames,
        null_code_shown=codes is not None and codes.null_code_shown,
        jaw=student.blend_shapes is not None and student.blend_shapes.config.jaw,
        reductions=config.reductions,
    )
    return save_bundle(path, about, pieces)


@dataclass(frozen=True, eq=False)
class _Cut:
    """The vertices and faces of a template that a player needs.

    Attributes:
        vertices: indices in the template, increasing.
        faces: faces with Gaussians, as indices into `vertices`.
        place: index of each of the template's vertices in `vertices`; -1: not among them.
    """

    vertices: Int64[np.ndarray, " V"]
    faces: Int64[np.ndarray, "F 3"]
    place: Int64[np.ndarray, " W"]

    @staticmethod
    def of(template: Template, faces: Int64[np.ndarray, " F"], garments: Sequence[Garment]) -> _Cut:
        # Vertices of faces with Gaussians, of the garments' particles, and of the body that cloth collides with.
        used = [template.faces[faces].ravel()]
        for garment in garments:
            used += [garment.particles, garment.collider.vertices]
        vertices = np.unique(np.concatenate(used))
        place = np.full(template.vertex_count, -1, dtype=np.int64)
        place[vertices] = np.arange(len(vertices))
        return _Cut(vertices, place[template.faces[faces]], place)


def _skeleton(template: Template) -> Tensors:
    body = template.body
    # Joints of an expression: the regressor is linear, so that it applies to the expression's directions too.
    moved = np.einsum("jv,vce->jce", body.joint_regressor, body.exprdirs)
    optional = ("left_hand_mean", "right_hand_mean", "left_hand_components", "right_hand_components")
    return {
        "parents": np.asarray(body.parents, np.int16),
        "joints": template.joints.astype(np.float32),
        "expression": moved.astype(np.float32),
        **{name: np.float32(getattr(body, name)) for name in optional if getattr(body, name) is not None},
    }


def _surface(template: Template, cut: _Cut, config: BundleConfig) -> Tensors:
    # The skin's vertices come first in a template, so that rows of a basis index the bundle's first vertices.
    at, body = cut.vertices, template.body
    skin = at[at < body.vertex_count]
    index, weights = template.weights.joint_indices[at], template.weights.joint_weights[at]
    # The heaviest first, without unused slots.
    order = np.argsort(-weights, axis=1, kind="stable")
    used = max(1, int((weights > 0).sum(axis=1).max()))
    index, weights = (np.take_along_axis(array, order, axis=1)[:, :used] for array in (index, weights))
    out: Tensors = {
        "vertices": template.vertices[at].astype(np.float32),
        "faces": cut.faces.astype(np.uint16 if len(at) <= 1 << 16 else np.uint32),
        "parts": template.vertex_part[at].astype(np.uint8),
        # Players know the built-in labels alone.
        "labels": template.labels.kind_ids(template.vertex_labels[at]).astype(np.uint8),
        "colors": template.vertex_colors[at],
        "joint_indices": index.astype(np.uint8),
    }
    out |= {"joint_weights": weights.astype(np.float32)} if config.exact else unsigned("joint_weights", weights, 16)
    for name, basis in (("expression", body.exprdirs), ("pose", body.posedirs)):
        if basis is None or (name == "pose" and not basis.shape[2]):
            continue
        # Rows that move less than half a step would be stored as zeros.
        own = basis[skin]
        rows = np.flatnonzero((np.abs(own) > (0.0 if config.exact else 0.5 * config.basis_step)).any(axis=(1, 2)))
        out[f"{name}_rows"] = rows.astype(np.int32)
        out |= {name: own[rows].astype(np.float32)} if config.exact else rounded(name, own[rows], config.basis_step)
    return out


def _gaussians(tensors: Mapping[str, Tensor], per_face: Int64[np.ndarray, " F"], config: BundleConfig) -> Tensors:
    # A player needs neither the offset along the normal on its own nor logits: fold them in.
    own = {name: value.numpy() for name, value in tensors.items()}
    offset = own["offset"].copy()
    offset[:, 0] += own["normal_offset"]
    opacities = torch.sigmoid(tensors["opacity_logits"].double()).numpy()
    quats = own["quats"] / np.linalg.norm(own["quats"], axis=1, keepdims=True)
    # A byte holds the number of Gaussians on a face, unless some face has more than 255.
    counts: Tensors = {"per_face": per_face.astype(np.uint8 if per_face.max(initial=0) < 256 else np.uint32)}
    plain = {"offset": offset, "log_scales": own["log_scales"], "dc": own["dc"]}
    fine = {"barycentric": own["barycentric"], "opacities": opacities}
    if config.exact:
        every = {**plain, **fine, "quats": quats, "sh": own["sh"]}
        return counts | {name: value.astype(np.float32) for name, value in every.items()}
    for name, value in fine.items():
        counts |= unsigned(name, np.clip(value, 0.0, 1.0), 16)
    return (
        counts | halves(plain) | signed("quats", quats, np.float32(1.0)) | signed("sh", own["sh"], _largest(own["sh"]))
    )


def _bare(template: Template, bound: BoundGaussians, config: BundleConfig) -> Tensors:
    """Return how Gaussians of the skin lie where a player takes off the part that hides them."""
    own = {name: value.numpy() for name, value in bound.tensors.items()} | {"face_index": bound.face_index.numpy()}
    own["offset"] = own["offset"] + np.eye(3, dtype=np.float32)[0] * own["normal_offset"][:, None]
    bare = bare_skin(template, {**own, "opacities": torch.sigmoid(bound.opacity_logits).numpy()})
    if not bare:
        return {}
    part = bare.pop("covered")
    out = {"covered": part.astype(np.uint8 if part.max(initial=0) < 256 else np.uint32)}
    if config.exact:
        return out | {name: value.astype(np.float32) for name, value in bare.items()}
    out |= halves({name: bare.pop(name) for name in ("bare_offset", "bare_scale")})
    out |= signed("bare_quats", bare.pop("bare_quats"), np.float32(1.0))
    return out | unsigned("bare_dc", np.clip(bare.pop("bare_dc"), 0.0, 1.0), 8)


def _largest(sh: Float[np.ndarray, "N K 3"]) -> Float[np.ndarray, "K 3"]:
    return np.maximum(np.abs(sh).max(axis=0, initial=0.0), 1e-6)


def _field(student: Student, cut: _Cut, config: BundleConfig) -> Tensors:
    net, codes, template = student.field, student.codes, student.rig.template
    assert net is not None and codes is not None
    # Control points are vertices of the template. A field with fewer of
    # them interpolates: keep the rows of the bundle's vertices alone.
    points = net.points.cpu().numpy()
    if net.rows is None:  # evaluated at every vertex: those of the bundle are enough
        points, kept = cut.vertices, cut.vertices
        neighbours, weights = np.arange(len(kept))[:, None], np.ones((len(kept), 1))
    else:
        kept = np.arange(len(points))
        neighbours, weights = (part.cpu().numpy() for part in net.rows.of(torch.as_tensor(cut.vertices)))
    # The network of clothes is evaluated at control points on clothes alone.
    clothes = template.cloth_mask[points]
    sets, member = _seen(net.sets, net.member, kept)
    small = np.uint16 if len(points) <= 1 << 16 else np.uint32
    out: Tensors = {
        "points": template.vertices[points].astype(np.float32),
        "neighbours": neighbours.astype(small),
        "cloth": np.flatnonzero(clothes).astype(small),
        "sets": sets.astype(np.uint8),
        "member": member.astype(small),
    }
    out |= {"weights": weights.astype(np.float32)} if config.exact else unsigned("weights", weights, 8)
    floats: Tensors = {"codes": _numbers(codes.codes)}
    for name, network in (("body", net.body), ("cloth", net.cloth)):
        hidden = [layer for layer in network.hidden if isinstance(layer, nn.Linear)]
        width = network.last.in_features
        floats |= {
            f"{name}.of_point.weight": _numbers(network.of_point.weight),
            f"{name}.of_frame.weight": _numbers(network.of_frame.weight),
            f"{name}.of_frame.bias": _numbers(network.of_frame.bias),
            f"{name}.hidden.weight": _stacked([layer.weight for layer in hidden], (width, width)),
            f"{name}.hidden.bias": _stacked([layer.bias for layer in hidden], (width,)),
            f"{name}.last.weight": _numbers(network.last.weight),
            f"{name}.last.bias": _numbers(network.last.bias),
        }
    return out | (floats if config.exact else halves(floats))


def _regression(student: Student, cut: _Cut, config: BundleConfig) -> Tensors:
    net, own = student.field, student.regression
    assert net is not None and own is not None
    kept = cut.vertices if net.rows is None else slice(None)
    moved = {"level": _numbers(own.level)[kept], "basis": _numbers(own.basis)[kept]}
    angles = {name: _numbers(getattr(own, name)) for name in ("rows", "center", "low", "high")}
    return angles | (moved if config.exact else halves(moved))


def _seen(
    sets: Tensor | None, member: Tensor | None, kept: Int64[np.ndarray, " C"]
) -> tuple[Bool[np.ndarray, "S 21"], Int64[np.ndarray, " C"]]:
    """Return the sets of joints that points depend on, and each point's set; one set of all joints by default."""
    if sets is None or member is None:
        return np.ones((1, BODY_JOINTS), dtype=bool), np.zeros(len(kept), dtype=np.int64)
    return sets.cpu().numpy()[:, ::3] > 0.5, member.cpu().numpy().argmax(axis=1)[kept]


def _blend(
    shapes: BlendShapes, order: Int64[Tensor, " N"], usual: Mapping[str, np.ndarray], config: BundleConfig
) -> Tensors:
    """Return blend shapes in the bundle's order of Gaussians, each side with the rows whose gate is above 0."""
    # Which row of the shapes belongs to the i-th Gaussian of the bundle; -1 where no shape moves it.
    count, n = shapes.count, shapes.config.head_shapes
    place = np.full(count, -1, dtype=np.int64)
    place[shapes.active.cpu().numpy()] = np.arange(len(shapes.active))
    place = place[order.numpy()]
    both = torch.cat([shapes.U, shapes.C], dim=1).detach().cpu().numpy()  # (M, 6, n)
    head = np.ones(count) if shapes.head_weight is None else shapes.head_weight.cpu().numpy()[order.numpy()]
    gates = {"head": head, "body": np.ones(count) if shapes.head_weight is None else 1.0 - head}
    networks, columns = {"head": shapes.head, "body": shapes.body}, {"head": slice(0, n), "body": slice(n, None)}
    out: Tensors = {}
    if shapes.part is not None:
        out["part"] = shapes.part.cpu().numpy()[order.numpy()].astype(np.uint16)
    # A gate is constant, so that it is multiplied into the shapes, and rows that it closes are left out.
    for side, gate in gates.items():
        rows = np.flatnonzero((gate > 0) & (place >= 0))
        values = (both[place[rows]][:, :, columns[side]] * gate[rows, None, None]).transpose(2, 1, 0)
        if len(rows) < count:
            out[f"{side}.rows"] = rows.astype(np.int32)
        if config.exact:
            out[f"{side}.values"] = values.astype(np.float32)
        else:
            steps = np.repeat([[config.position_step, config.color_step]], 3, axis=1) / usual[side][:, None]
            out |= blended(side, values, steps)
        # The networks of the coefficients, with the hidden layers stacked into one tensor.
        layers = [layer for layer in networks[side].children() if isinstance(layer, nn.Linear)]
        first, hidden, last = layers[0], layers[1:-1], layers[-1]
        width = last.in_features
        floats = {
            f"{side}.first.weight": _numbers(first.weight),
            f"{side}.first.bias": _numbers(first.bias),
            f"{side}.hidden.weight": _stacked([layer.weight for layer in hidden], (width, width)),
            f"{side}.hidden.bias": _stacked([layer.bias for layer in hidden], (width,)),
            f"{side}.last.weight": _numbers(last.weight),
            f"{side}.last.bias": _numbers(last.bias),
        }
        out |= floats if config.exact else halves(floats)
    return out


def _garments(extras: BundleExtras, cut: _Cut) -> tuple[Tensors, Mapping[str, Any]]:
    """Return garments over the bundle's vertices, with float64 arrays narrowed to float32, and how they are stepped."""
    own = [garment.with_vertices_at(cut.place) for garment in extras.garments]
    arrays, about = garments_to_arrays(own)
    narrow = {name: value.astype(np.float32) for name, value in arrays.items() if value.dtype == np.float64}
    return {**arrays, **narrow}, {**about, "simulation": asdict(extras.cloth)}


def _numbers(value: Tensor) -> Float[np.ndarray, "*N"]:
    return value.detach().cpu().numpy()


def _stacked(values: Sequence[Tensor], shape: tuple[int, ...]) -> Float[np.ndarray, "*N"]:
    return np.stack([_numbers(value) for value in values]) if values else np.zeros((0, *shape), np.float32)
