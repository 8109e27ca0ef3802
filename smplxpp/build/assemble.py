"""Assemble body and parts into one template: fill holes of cut bridges, separate layers, colour the skin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Integer

from smplxpp.assemble import (
    FilledHoles,
    FillHolesConfig,
    body_colors_from_scan,
    cut_holes,
    cut_slits,
    fill_holes,
    part_legs,
)
from smplxpp.assemble.build import AssemblyConfig, CanonicalPart, assemble_template
from smplxpp.assemble.patch import drape_patches
from smplxpp.body import BodyModel
from smplxpp.build.completeness import photograph_views
from smplxpp.build.config import BuildConfig, BuildInputs
from smplxpp.build.data import Part, PosedFit, PreparedScan, RestPart
from smplxpp.build.parts import without_lids
from smplxpp.build.scan import raw_scan
from smplxpp.clean.shreds import cut_borders
from smplxpp.clean.smooth import smooth_cuts
from smplxpp.core import (
    LABELS,
    OBJECT,
    SKIN,
    BodyParams,
    Check,
    InputError,
    Labels,
    SkinWeights,
    StageOutput,
    TriangleMesh,
)
from smplxpp.metrics.comparison import MM
from smplxpp.skinning import pose
from smplxpp.template.mouth import MOUTH_COLOR, inside_of_mouth
from smplxpp.template.template import Template
from smplxpp.texture.atlas import can_unwrap, texture_stretch, unwrap
from smplxpp.texture.bake import bake
from smplxpp.texture.painted_scan import PaintedScan, pictures_of
from smplxpp.texture.photographs import Painter, Photograph, PhotographPainter, finer_than_the_scan

# Pixels of the longer side at which photographs are read: two a texel of a person that fills a 2048 texture's views.
_LONGER_SIDE = 2400


def assemble_parts(
    body: BodyModel,
    params: BodyParams,
    scan: PreparedScan,
    face_labels: Integer[np.ndarray, " M"],
    fit: PosedFit,
    cleaned: Mapping[str, Part],
    parts: Mapping[str, RestPart],
    config: BuildConfig,
    *,
    labels: Labels = LABELS,
) -> tuple[Template, StageOutput]:
    """Put body and parts together as one `Template`, with its layers apart.

    Args:
        body: the model of the fit.
        params: of the scan's pose; its shape becomes the template's.
        scan: prepared, for the colours of the skin.
        face_labels: of the scan.
        fit: the posed body.
        cleaned: the parts before lids and bridges were cut; without lids they tell the holes of a cut from openings.
        parts: the same parts without bridges, in the T-pose.
        config: choices of the build.
        labels: what the ids of labels stand for.
    """
    kinds = labels.kind_ids(face_labels)
    canonical, filled = {}, {}
    # Where a thing was taken off, the scan lacks the cloth behind it, and the thing's own back.
    taken = np.zeros(scan.mesh.vertex_count, dtype=bool)
    taken[scan.mesh.faces[kinds == OBJECT.id]] = True
    words = ("hip", "knee", "ankle", "foot")
    own = [joint if any(word in joint for word in words) else "" for joint in body.joint_names]
    legs = np.array([1.0 * joint.startswith("left") - joint.startswith("right") for joint in own])
    for name, scanned in cleaned.items():
        # A part's vertices at rest come from the inverse skinning of its posed mesh. The faces are the same in both
        # poses.
        part = parts[name].posed
        # What the transfer cut as lids left openings. They are found again, as stages keep parts as they were cleaned.
        before = without_lids(scanned, fit, labels)
        made = CanonicalPart(
            mesh=part.mesh.with_vertices(parts[name].vertices),
            weights=parts[name].weights,
            label=part.label,
            vertex_colors=part.colors,
            scan_index=_of_file(scan, part.source_vertex),
        )
        canonical[name], filled[name] = _filled(
            made, before, part, fit, taken=taken, legs=legs, config=config.fill_holes
        )
    # The clearance is given in millimetres by the user; every length inside the package is in metres.
    settings = AssemblyConfig(clearance=config.clearance_mm / MM, labels=labels)
    template, report = assemble_template(body, params, canonical, config=settings)
    # A body vertex takes the colour of the scan's skin where that is close; elsewhere the median of the skin that is
    # seen.
    template = _with_scan_colors(template, scan, kinds == SKIN.id, fit, body)
    # A layer that penetrates another shows through it, so that the first check allows no such vertex (limits 0). What
    # the repair leaves inside is zero unless the fit is wrong, since no part may be pushed farther than it stands off
    # the body.
    checks = [
        Check(
            "outer vertices inside an inner layer at rest",
            report.penetrating_after,
            "",
            0,
            0,
            explanation="after the repair",
        ),
        Check(
            "depth of what the repair leaves inside",
            report.remaining_depth * MM,
            "mm",
            0.0,
            5.0,
            explanation=f"the body does not fit the scan here: register first. {report.remaining_where}"
            if report.remaining_where
            else "nothing needs a larger push than what its part stands off the body",
        ),
        Check(
            "largest push of the repair",
            report.max_push * MM,
            "mm",
            15.0,
            60.0,
            explanation=f"{report.max_push_where or 'none'}; no part is pushed farther than it stands off the body "
            "(10 to 30 mm) and the clearance",
        ),
    ]
    numbers = report.as_dict() | {"darned": {name: one.as_dict() for name, one in filled.items()}}
    return template, StageOutput(checks, numbers)


def add_texture(
    template: Template,
    params: BodyParams,
    scan: PreparedScan,
    face_labels: Integer[np.ndarray, " M"],
    inputs: BuildInputs,
    config: BuildConfig,
    body: BodyModel,
) -> tuple[Template, dict[str, Any]]:
    """Paint the texture of an assembled template with what the scan shows, in the scan's pose.

    Args:
        template: body and parts in the T-pose.
        params: of the scan's pose.
        scan: prepared.
        face_labels: of the scan.
        inputs: they name the scan, whose textures are read again, and photographs of its moment.
        config: size and layout.
        body: the model, whose file may have a layout.

    Returns:
        The template with its texture, or as it is where none was asked for or there is nothing to paint, and numbers.
    """
    if not config.texture_size:
        return template, {"texture": "none was asked for"}
    if not can_unwrap():
        return template, {"texture": "none: xatlas, which unwraps, is not installed (pip install xatlas)"}
    raw = raw_scan(inputs.scan) if inputs.scan is not None else None
    pictures = None if raw is None else pictures_of(raw, scan.mesh, scan.source_vertex, scan.source_face)
    views, unread = photograph_views(inputs, longer_side=_LONGER_SIDE) if pictures is None else ([], [])
    photographs = [Photograph(camera, color) for camera, color in views]
    if scan.own_colors is None and pictures is None and not photographs:
        return template, {"texture": "none: neither the scan nor photographs have colours"}
    # Classes of skin of a user's own are the body's, as the built-in one is.
    skin = template.labels.kind_ids(face_labels) == SKIN.id
    painted = PaintedScan(scan.mesh, scan.colors, np.where(skin, SKIN.id, face_labels), pictures)
    # Photographs whose pixels are coarser than the scan's vertices would blur what the scan has.
    photographed = scan.own_colors is None or finer_than_the_scan(scan.mesh, photographs)
    paint: Painter = painted.colors_at
    if photographs and photographed:
        paint = PhotographPainter(scan.mesh, photographs, painted.colors_at)
    # The inside of the mouth has a colour that no scan shows.
    mouth = (template.vertex_colors == MOUTH_COLOR).all(axis=1) & (template.scan_index < 0)
    atlas = unwrap(template, body.uv, layout=config.texture_layout)
    texture, report = bake(
        *(template, template.pose(params)[0], atlas, painted),
        size=config.texture_size,
        paint=paint,
        fixed=mouth & (template.vertex_part == 0),
        normals=config.normal_map,
    )
    stretch, _ = texture_stretch(atlas, template.mesh)
    source = "of the scan's texture" if pictures is not None else "of the colours of the scan's vertices"
    numbers = {
        "texture": f"of {len(photographs)} photographs" if isinstance(paint, PhotographPainter) else source,
        "texture_unread": unread,
        "texture_seen": report.by_part,
        "texture_stretch": stretch,
        "texture_texels": report.texels,
        "texture_bytes": sum(map(len, (*texture.colors, *texture.normals))),
    }
    return replace(template, texture=texture), numbers


def _filled(
    made: CanonicalPart,
    before: Part,
    part: Part,
    fit: PosedFit,
    *,
    taken: Bool[np.ndarray, " N"],
    legs: Float[np.ndarray, " J"],
    config: FillHolesConfig,
) -> tuple[CanonicalPart, FilledHoles]:
    """Close the holes and slits that cut bridges left in a part; cuffs and hems were open before and stay open.

    Their borders are smoothed first, and the patches draped over the body at last.

    Args:
        made: the part at rest.
        before: the cleaned part, before bridges were cut.
        part: the same without bridges.
        fit: the body in the scan's pose and at rest.
        taken: the scan's vertices at which a thing was taken off.
        legs: 1 for joints of the left leg, -1 for those of the right one, 0 for others.
        config: options.
    """
    opened = before.source_vertex[np.unique(before.mesh.border_edges)]
    cut = cut_borders(made.mesh, np.isin(part.source_vertex, opened))
    if cut.any():
        made = _with_smooth_cuts(made, cut, part.mesh, fit)
    # Trouser legs that were fused get their inner sides back, however wide.
    parted = FilledHoles()
    if config.width:
        made, walls = part_legs(made, np.isin(part.source_vertex, opened), made.weights.dense() @ legs)
        any_width = 2.0  # metres: no wall between trouser legs is wider
        made, parted = fill_holes(made, walls, config=replace(config, width=any_width))
    source = np.concatenate([part.source_vertex, np.full(made.mesh.vertex_count - part.mesh.vertex_count, -1)])
    borders = (before.mesh, before.source_vertex, made.mesh, source)
    holes = cut_holes(*borders, taken=taken)
    behind = [bool(taken[source[hole]].any()) for hole in holes]
    out, narrow = fill_holes(made, [hole for hole, wide in zip(holes, behind, strict=True) if not wide], config=config)
    # Slits have straight ends across a hem or a cuff, and a thing is as wide as it is: neither can become a sail.
    wide = [*(hole for hole, wide in zip(holes, behind, strict=True) if wide), *cut_slits(*borders, taken=taken)]
    out, others = fill_holes(out, wide, config=replace(config, width=1.2 * config.width))
    patched = np.arange(out.mesh.vertex_count) >= part.mesh.vertex_count
    return drape_patches(out, patched, fit.at_rest), parted + narrow + others


def _with_smooth_cuts(
    part: CanonicalPart, cut: Bool[np.ndarray, " N"], scanned: TriangleMesh, fit: PosedFit
) -> CanonicalPart:
    """Return the part with smooth borders of cuts; its weights move along, so that it keeps its place in the scan.

    Vertices of faces that would face another way than in the scan stay.
    """
    old, rows = part.weights, part.weights.dense()
    kept = {name: getattr(old, name) for name in ("matched", "distance", "angle", "component", "policies")}
    still = np.zeros(part.mesh.vertex_count, dtype=bool)
    while True:
        mesh, moved = smooth_cuts(part.mesh, cut & ~still, rows)
        vertices = np.where(still[:, None], part.mesh.vertices, mesh.vertices)
        moved = np.where(still[:, None], rows, moved)
        weights = SkinWeights.from_dense(moved, max_influences=old.joint_indices.shape[1], **kept)
        posed = scanned.with_vertices(pose(vertices, weights, fit.posed_from_rest))
        turned = np.einsum("ij,ij->i", posed.face_cross, scanned.face_cross) < 0
        corners = np.unique(scanned.faces[turned])
        if still[corners].all():
            return replace(part, mesh=part.mesh.with_vertices(vertices), weights=weights)
        still[corners] = True


def _of_file(scan: PreparedScan, vertices: Integer[np.ndarray, " n"]) -> Integer[np.ndarray, " n"]:
    """The vertex of the user's file for vertices of the prepared scan.

    Raises:
        InputError: vertices that the scan does not have.
    """
    count = len(scan.source_vertex)
    if vertices.size and not (vertices.min() >= 0 and vertices.max() < count):
        raise InputError("part: source_vertex", expected=f"vertices of the scan, below {count}", received="others")
    return scan.source_vertex[vertices]


def _with_scan_colors(
    template: Template, scan: PreparedScan, skin: np.ndarray, fit: PosedFit, body: BodyModel
) -> Template:
    """The template with the scan's colours on the skin that the scan shows, and a dark inside of the mouth."""
    body_colors, body_index = body_colors_from_scan(fit.mesh, scan.mesh, scan.colors, skin)
    count = body.vertex_count
    # The scan's nearest skin is that of the lips, so that the inside of the mouth would become red.
    mouth = inside_of_mouth(template)[:count]
    body_colors[mouth], body_index[mouth] = MOUTH_COLOR, -1
    # -1 marks a vertex of the template that no vertex of the scan's file stands for.
    scan_index = np.where(body_index >= 0, scan.source_vertex[body_index], -1)
    # The template lists the body's vertices first, `count` of them, and the parts' vertices after them.
    return replace(
        template,
        vertex_colors=np.concatenate([body_colors, template.vertex_colors[count:]]),
        scan_index=np.concatenate([scan_index, template.scan_index[count:]]),
    )
