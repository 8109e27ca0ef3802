"""Assemble the naked body and the parts in the T-pose to one template, outer layers pushed out of inner ones."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata

import numpy as np
from jaxtyping import Int, UInt8
from scipy.spatial import cKDTree

from smplxpp.assemble.body_inside import feet_in_shoes, part_lips
from smplxpp.assemble.layers import (
    Obstacle,
    Penetration,
    RemainingPenetration,
    joints_near,
    measure_penetration,
    remaining_penetration,
)
from smplxpp.assemble.push_out import PushConfig, flipped_faces, push_out, stand_off
from smplxpp.body.model import BodyModel
from smplxpp.core import (
    LABELS,
    OBJECT,
    SHOE,
    SKIN,
    BodyParams,
    GeometryWarning,
    InputError,
    Label,
    Labels,
    SkinWeights,
    TriangleMesh,
    concatenate_meshes,
)
from smplxpp.core.errors import one_line
from smplxpp.template.template import BODY_PART, Template


@dataclass(frozen=True, eq=False)
class CanonicalPart:
    """A garment, shoes or hair in the T-pose.

    Attributes:
        mesh: N vertices, metres.
        weights: skin weights of the N vertices.
        label: label id (`smplxpp.core.labels`).
        vertex_colors: (N, 3) uint8 sRGB.
        scan_index: the scan's vertex of each vertex, -1 for none; `assemble_template` checks that S = N.
    """

    mesh: TriangleMesh
    weights: SkinWeights
    label: int
    vertex_colors: UInt8[np.ndarray, "N 3"]
    scan_index: Int[np.ndarray, " S"]

    __repr__ = one_line


@dataclass(frozen=True)
class AssemblyConfig:
    """Options of assembling a template with `assemble_template`.

    Attributes:
        clearance: distance between layers after the repair, metres.
        push: the other options of the repair.
        labels: what the parts' labels stand for; their layers are the order from the skin outwards. Things (kind
            `object`) are no layers and stay where they are.
        skin_color: sRGB of the body's vertices.
    """

    clearance: float = 1e-3
    push: PushConfig = field(default_factory=PushConfig)
    labels: Labels = LABELS
    skin_color: tuple[int, int, int] = (205, 170, 150)


@dataclass(frozen=True)
class LayerReport:
    """Penetrations of one part before and after the repair, and its displacements.

    Attributes:
        before: penetration into each inner layer before the repair.
        after: penetration into each inner layer after it.
        moved: number of vertices moved.
        max_push: largest displacement, metres.
        mean_push: mean displacement of the moved vertices, metres.
        flipped_faces: faces flipped by the repair.
        max_push_near: joint nearest to the largest displacement; empty if nothing moved.
        push_limit: largest displacement allowed, metres: the part's stand-off and the clearance.
        remaining: vertices that would have needed more.
    """

    before: tuple[Penetration, ...]
    after: tuple[Penetration, ...]
    moved: int
    max_push: float
    mean_push: float
    flipped_faces: int
    max_push_near: str
    push_limit: float
    remaining: RemainingPenetration


@dataclass(frozen=True)
class AssemblyReport:
    """Reports of the repair by part, in the order of the repairs."""

    parts: dict[str, LayerReport]

    @property
    def penetrating_before(self) -> int:
        """Return the number of vertices inside an inner layer before the repair, counted once for each inner layer."""
        return sum(p.vertices for part in self.parts.values() for p in part.before)

    @property
    def penetrating_after(self) -> int:
        """Return the number of vertices inside an inner layer after the repair."""
        return sum(p.vertices for part in self.parts.values() for p in part.after)

    @property
    def max_push(self) -> float:
        """Return the largest displacement of a vertex, metres."""
        return max((part.max_push for part in self.parts.values()), default=0.0)

    @property
    def max_push_where(self) -> str:
        """Return the part and the joint of the largest displacement as text; empty if nothing moved."""
        name, part = max(self.parts.items(), key=lambda item: item[1].max_push, default=("", None))
        return f"{name}, near {part.max_push_near.replace('_', ' ')}" if part and part.max_push_near else ""

    @property
    def remaining_depth(self) -> float:
        """Return the largest depth, metres, of a vertex that stays inside an inner layer; 0 for none."""
        return max((part.remaining.depth for part in self.parts.values()), default=0.0)

    @property
    def remaining_where(self) -> str:
        """Return a summary, part by part, of vertices that stay inside; empty for none."""
        parts = self.parts.items()
        return "; ".join(f"{name}: {part.remaining.summary}" for name, part in parts if part.remaining.vertices)

    def as_dict(self) -> dict:
        """Return the report as plain numbers, for JSON; lengths in metres."""
        totals = ("penetrating_before", "penetrating_after", "max_push")
        return {name: getattr(self, name) for name in totals} | asdict(self)


def assemble_template(
    body: BodyModel,
    params: BodyParams,
    parts: Mapping[str, CanonicalPart],
    *,
    config: AssemblyConfig | None = None,
) -> tuple[Template, AssemblyReport]:
    """Put the shaped body and its parts together, outer layers pushed out of inner ones.

    Parts are processed from the skin outwards (`Labels.layer_order`); each is pushed out of the body and of every
    part inside it, which were repaired before; feet are drawn into their shoes (`feet_in_shoes`). Vertices that keep
    the clearance stay, but for those around a push. No part is pushed farther than it stands off the body
    (`stand_off`). If that is not enough, the body does not fit the scan, and the report names the place.

    Args:
        body: the body model; its betas are baked in, its bases stay.
        params: one frame; only the betas are used.
        parts: by name, in the T-pose of `body` with these betas.
        config: clearance and order.

    Returns:
        The template (body first, then the parts in the mapping's order) and the report of the repair.

    Raises:
        InputError: more than one frame, a part named "body", unknown label, arrays that do not fit.

    Warns:
        GeometryWarning: vertices that stay inside an inner layer, or flipped faces.
    """
    config = config or AssemblyConfig()
    if len(params) != 1:
        raise InputError("parameters", expected="one frame", received=f"{len(params)}", remedy="choose it with frame()")
    for name, part in parts.items():
        _check_part(name, part, body, config)
    # The shaped body in its T-pose; then the parts in order of layers; then one template of all.
    neutral = BodyParams.rest(betas=params.betas[0], expressions=0, v_shape=params.v_shape)
    # Without the mean hand, because its pose correctives are not part of the T-pose.
    rest = body.forward(neutral, flat_hand_mean=True).rest_vertices[0]
    # Feet yield to shoes, everything else to the body; lips part where a jaw opens.
    body = part_lips(body)
    shoes = [(part.mesh, part.weights) for part in parts.values() if is_shoe(config.labels[part.label])]
    rest, body = feet_in_shoes(body, rest, shoes)
    body_mesh = body.mesh(rest)
    meshes, report = _separate(body, body_mesh, parts, config)
    template = _template(body, params.betas[0], [body_mesh, *(meshes[name] for name in parts)], parts, config)
    return template, report


def is_shoe(label: Label) -> bool:
    """Whether a part of this label is stiff below the ankle, as shoes are and socks (tight) are not."""
    return label.kind == SHOE.name and not label.tight and label.rule == "auto"


def _check_part(name: str, part: CanonicalPart, body: BodyModel, config: AssemblyConfig) -> None:
    # Each row: the condition, what was expected, and what was received.
    count = part.mesh.vertex_count
    allowed = [label.id for label in config.labels if label.kind != SKIN.name]
    checks = [
        (name != BODY_PART, "another name than the body's", repr(name)),
        (
            part.label in allowed,
            f"a label of {tuple(allowed)}",
            str(part.label),
        ),
        (part.mesh.face_count > 0, "a mesh with faces", "none"),
        (len(part.weights) == count, f"weights of {count} vertices", str(len(part.weights))),
        (part.weights.joint_count == body.joint_count, f"{body.joint_count} joints", str(part.weights.joint_count)),
        (np.shape(part.vertex_colors) == (count, 3), f"colours ({count}, 3)", str(np.shape(part.vertex_colors))),
        (np.shape(part.scan_index) == (count,), f"scan indices ({count},)", str(np.shape(part.scan_index))),
    ]
    for good, expected, received in checks:
        if not good:
            raise InputError(f"part {name!r}", expected=expected, received=received)


def _separate(
    body: BodyModel, body_mesh: TriangleMesh, parts: Mapping[str, CanonicalPart], config: AssemblyConfig
) -> tuple[dict[str, TriangleMesh], AssemblyReport]:
    """Push every part out of the body and of the layers inside it; return the meshes by name, and the report."""
    push = replace(config.push, clearance=config.clearance)
    obstacles = [Obstacle(BODY_PART, body_mesh, solid=True, max_depth=push.max_depth)]
    # Fingers close round a thing in a hand, so that it is no layer, and pushing it out would bend it.
    labels = config.labels
    meshes = {name: part.mesh for name, part in parts.items() if labels[part.label].kind == OBJECT.name}
    reports = {}
    # Parts of one label lie side by side and are no obstacles to each other.
    for label in labels.layer_order:
        layer = [name for name, part in parts.items() if part.label == label]
        # A foot yields to its shoe, whose long faces beside an arch or a heel would bulge.
        of_layer = replace(push, spacing=np.inf) if is_shoe(labels[label]) else push
        for name in layer:
            mesh = parts[name].mesh
            meshes[name], reports[name] = _separate_part(mesh, obstacles, of_layer, (body, body_mesh))
            _warn_of_rest(name, reports[name])
        obstacles += [Obstacle(name, meshes[name], solid=False, max_depth=push.max_depth) for name in layer]
    return meshes, AssemblyReport(reports)


def _separate_part(
    mesh: TriangleMesh, obstacles: list[Obstacle], push: PushConfig, shaped: tuple[BodyModel, TriangleMesh]
) -> tuple[TriangleMesh, LayerReport]:
    # Push the part out, up to its stand-off, and compare its penetrations before and after.
    before = tuple(measure_penetration(mesh, obstacle) for obstacle in obstacles)
    limit = stand_off(mesh, obstacles[0], push) + push.clearance
    moved = mesh.with_vertices(push_out(mesh, obstacles, push, limit=limit))
    after = tuple(measure_penetration(moved, obstacle) for obstacle in obstacles)
    length = np.linalg.norm(moved.vertices - mesh.vertices, axis=1)
    # A smoothed displacement decays without end; less than a micrometre does not count.
    edited = length[length > 1e-6]
    report = LayerReport(
        before=before,
        after=after,
        moved=len(edited),
        max_push=float(length.max(initial=0.0)),
        mean_push=float(edited.mean()) if len(edited) else 0.0,
        flipped_faces=int(flipped_faces(mesh, moved.vertices).sum()),
        max_push_near=next(iter(joints_near(moved.vertices[[length.argmax()]], *shaped))) if len(edited) else "",
        push_limit=limit,
        remaining=remaining_penetration(moved, obstacles, *shaped),
    )
    return moved, report


def _warn_of_rest(name: str, report: LayerReport) -> None:
    if report.remaining.vertices or report.flipped_faces:
        where = f" ({report.remaining.summary})" if report.remaining.vertices else ""
        warnings.warn(
            f"part {name!r}: {report.remaining.vertices} vertices stay inside an inner layer{where}, "
            f"{report.flipped_faces} faces turned over; the fit or the skin weights are far off there",
            GeometryWarning,
            stacklevel=4,
        )


def _template(
    body: BodyModel,
    betas: np.ndarray,
    meshes: list[TriangleMesh],
    parts: Mapping[str, CanonicalPart],
    config: AssemblyConfig,
) -> Template:
    # Concatenate the arrays of body and parts; a part's vertex refers to the nearest vertex of the body.
    whole, count = concatenate_meshes(meshes), body.vertex_count
    sizes = [mesh.vertex_count for mesh in meshes]
    labels = [SKIN.id, *(part.label for part in parts.values())]
    colors = [np.tile(np.array(config.skin_color, np.uint8), (count, 1)), *(p.vertex_colors for p in parts.values())]
    scan_index = [np.full(count, -1), *(part.scan_index for part in parts.values())]
    nearest = cKDTree(whole.vertices[:count]).query(whole.vertices[count:])[1]
    return Template(
        body=body,
        vertices=whole.vertices,
        faces=whole.faces,
        vertex_labels=np.repeat(labels, sizes),
        vertex_part=np.repeat(np.arange(len(sizes)), sizes),
        part_names=(BODY_PART, *parts),
        vertex_colors=np.concatenate(colors),
        weights=_stack([SkinWeights.from_dense(body.weights), *(part.weights for part in parts.values())]),
        betas=betas,
        body_index=np.concatenate([np.arange(count), nearest]),
        scan_index=np.concatenate(scan_index),
        metadata={"body": body.name, "smplxpp": metadata.version("smplxpp")},
        labels=config.labels,
    )


def _stack(weights: list[SkinWeights]) -> SkinWeights:
    """Concatenate skin weights; slots are padded with joint 0 at weight 0, components are numbered consecutively."""
    width = max(w.joint_indices.shape[1] for w in weights)

    def padded(values: np.ndarray) -> np.ndarray:
        return np.pad(values, ((0, 0), (0, width - values.shape[1])))

    # Components of a part follow those of the parts before it.
    merged = {name: np.concatenate([getattr(w, name) for w in weights]) for name in ("matched", "distance", "angle")}
    start = np.cumsum([0] + [_components(w) for w in weights])
    return SkinWeights(
        joint_indices=np.concatenate([padded(w.joint_indices) for w in weights]),
        joint_weights=np.concatenate([padded(w.joint_weights) for w in weights]),
        joint_count=weights[0].joint_count,
        component=np.concatenate([w.component + s for w, s in zip(weights, start, strict=False)]).astype(np.int32),
        policies=tuple(policy for w in weights for policy in (w.policies or ("given",) * _components(w))),
        **merged,
    )


def _components(weights: SkinWeights) -> int:
    return int(weights.component.max(initial=-1)) + 1
