"""Validate a template against the scan it came from, and under poses that try its skinning."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from smplxpp.body.named_poses import STRESS_POSES, WORN_POSES, stress_poses, worn_poses
from smplxpp.build.completeness import completeness_checks, photograph_checks
from smplxpp.build.config import BuildConfig, BuildInputs
from smplxpp.build.data import Part, PreparedScan
from smplxpp.clean import loop_lengths, thickened
from smplxpp.core import (
    BACKGROUND,
    SKIN,
    BodyParams,
    Check,
    InputError,
    Labels,
    StageOutput,
    TriangleMesh,
    row_lengths,
    spread,
)
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.solids import closed_mesh
from smplxpp.core.topology import border_loops
from smplxpp.metrics import CompareConfig, DirectedDistances, directed_distances, point_to_surface, summarize
from smplxpp.metrics.comparison import MM
from smplxpp.metrics.conventions import convention_named
from smplxpp.metrics.intersections import interpenetration
from smplxpp.metrics.quality import mesh_quality
from smplxpp.metrics.stretch import stretch_report
from smplxpp.skinning import skin
from smplxpp.template.template import BODY_PART, Template
from smplxpp.transfer import TransferConfig
from smplxpp.transfer.checks import extent
from smplxpp.transfer.enclosed import enclosed_by_one, limb_axes


@dataclass(frozen=True, eq=False)
class Validation:
    """Distances between a template in the reference pose and its scan.

    Attributes:
        to_scan: from the template's visible points.
        to_template: from the scan's visible points.
    """

    to_scan: DirectedDistances
    to_template: DirectedDistances


def validate_template(
    template: Template,
    params: BodyParams,
    scan: PreparedScan,
    face_labels: np.ndarray,
    parts: Mapping[str, Part],
    motion: BodyParams | None,
    inputs: BuildInputs,
    config: BuildConfig,
) -> tuple[Validation, StageOutput]:
    """Measure distances to the scan in the reference pose, turned faces, and stretch under hard poses and the motion.

    Args:
        template: of the scan.
        params: of the scan's pose.
        scan: prepared.
        face_labels: (M,) of the scan.
        parts: the cleaned parts in the scan's pose, without bridges.
        motion: frames of the capture; None: there are none.
        inputs: they name photographs, which tell a mirrored scan.
        config: choices of the build.
    """
    # Pose with the parameters of the scan: the template should then lie on the scan.
    posed = template.mesh.with_vertices(template.pose(params)[0])
    # Patches over the holes of cuts are guesses where the scan shows nothing, so that they count for no label.
    guessed = (template.scan_index < 0) & (template.vertex_part != template.part_names.index(BODY_PART))
    labels = np.where(guessed, BACKGROUND, template.vertex_labels)
    found, checks, numbers = _against_scan(posed, labels, scan.mesh, face_labels, config, template.labels)
    whole, numbers["completeness"] = completeness_checks(template, params, scan.mesh, face_labels, found.to_template)
    checks += whole
    seen, numbers["photographs"] = photograph_checks(template, params, scan.mesh, scan.colors, inputs)
    checks += seen
    # Quality at rest, because the rest pose is what is exported.
    quality = {name: mesh_quality(template.part_mesh(name)) for name in template.part_names}
    numbers["quality"] = {name: q.as_dict() for name, q in quality.items()}
    numbers["shared_volume"] = _shared_volumes(template)
    turned = _turned_faces(template, posed, parts)
    # A sheet that folds over has hundreds of faces; real scans have up to nine slivers beside cuts that nothing shows.
    most_slivers = 20
    checks.append(Check("faces of the parts turned over against the cleaned scan", turned, "", 0, most_slivers))
    # Stretch under poses that are rarely recorded, and under a dozen recorded frames.
    motion_frames = 12
    poses = {"hard poses": stress_poses(params), "worn poses": worn_poses(params)}
    if motion is not None:
        poses["motion"] = motion.select(spread(range(len(motion)), motion_frames))
    for title, tried in poses.items():
        known = {"hard poses": list(STRESS_POSES), "worn poses": list(WORN_POSES)}
        names = known.get(title) or [f"frame {k}" for k in range(len(tried))]
        numbers[title], worst = _stretch(template, tried, names)
        checks.append(
            Check(
                f"edge stretch p99.9, {title}",
                worst,
                "x",
                3.0,
                10.0,
                explanation="the worst part and pose, over what the pose asks of the part's longest opening",
            )
        )
    worn, numbers["worn"] = worn_checks(template, params)
    return found, StageOutput([*checks, *worn], numbers)


def worn_checks(template: Template, params: BodyParams) -> tuple[list[Check], dict[str, dict[str, float]]]:
    """Drive each part through `WORN_POSES`; check that its rings stay around their limbs, and count faces in the body.

    A ring around one limb (`enclosed_by_one`) keeps its distance from the limb's axis, which moves with the skin around
    it: wide trousers that stay behind a raised thigh are far from it. Cloth whose weights are right still meets the
    body where limbs press on it, as a skirt does in front of a seated person, so that deep faces warn alone.

    Args:
        template: of the scan.
        params: the person; only the first frame is used.
    """
    rest_body = template.part_mesh(BODY_PART)
    weights, dense = template.body.weights, template.weights.dense()
    settings = TransferConfig(joint_names=template.body.joint_names)
    axes = limb_axes(rest_body, weights, extent(rest_body), settings)
    tried = worn_poses(params)
    transforms, posed = template.posed_from_rest(tried), template.pose(tried)
    fields = [SignedDistanceField(rest_body.with_vertices(p[: template.body.vertex_count]), solid=True) for p in posed]
    checks: list[Check] = []
    numbers: dict[str, dict[str, float]] = {}
    for part in template.part_names:
        if part == BODY_PART:
            continue
        chosen = template.part_faces(part)
        mesh, used = template.mesh.submesh(chosen)
        # How much farther from the axis rings are than at rest, by pose.
        row = {}
        if axes:
            rings = enclosed_by_one(mesh, axes, dense.shape[1])
            kept = rings.share > 0.5
            before = row_lengths(mesh.vertices - rings.centre)[kept]
            for name, vertices, moved in zip(WORN_POSES, posed, transforms, strict=True):
                after = row_lengths(vertices[used] - skin(rings.centre, _or_first(rings.weights), moved))[kept]
                row[f"{name}: rings off their limb, mm"] = (
                    float(np.percentile(after - before, 95) * MM) if kept.any() else 0.0
                )
        # Faces deeper than 1 cm within the body.
        for name, vertices, field in zip(WORN_POSES, posed, fields, strict=True):
            depth = field.query(vertices[template.faces[chosen]].mean(axis=1)).distance
            row[f"{name}: faces in the body"] = float((depth < -0.01).mean())
        numbers[part] = row
        farthest = max((value for key, value in row.items() if key.endswith("mm")), default=0.0)
        deep = max(value for key, value in row.items() if key.endswith("body"))
        checks += [
            Check(f"{part}: rings off their limb, worn poses, p95", farthest, "mm", 30.0, 60.0),
            Check(f"{part}: share of faces in the body, worn poses", deep, "", 0.25, 1.0),
        ]
    return checks, numbers


def _or_first(weights: np.ndarray) -> np.ndarray:
    """Return weights with all weight on the first joint in rows that have none."""
    out = weights.copy()
    out[~weights.any(axis=1), 0] = 1.0
    return out


def _against_scan(
    posed: TriangleMesh,
    vertex_labels: np.ndarray,
    scan: TriangleMesh,
    face_labels: np.ndarray,
    config: BuildConfig,
    names: Labels,
) -> tuple[Validation, list[Check], dict]:
    """Distances between the posed template and the scan, both ways, by label."""
    # Scanners do not see pockets, armpits and inner layers: only points visible from outside are compared.
    measured = partial(
        directed_distances, samples=config.samples, seed=config.seed, config=CompareConfig(visible_only=True)
    )
    # Both directions with one seed: template to scan finds invented surface, scan to template finds lost surface.
    forth = measured(posed, scan, source_labels=vertex_labels, target_labels=face_labels)
    back = measured(scan, posed, source_labels=face_labels, target_labels=vertex_labels)
    result = summarize(forth, back, convention=convention_named("smplxpp"), threshold_mm=5.0, names=names)
    checks = []
    for label in names:
        found = result.labels.get(label.name)
        # Skin is checked below, since its distance measures the fit and not the template.
        if found is None or found.pred_to_gt is None or label == SKIN:
            continue
        # Millimetres, (warn, fail) of the mean and of the p95. Hair and shoes get wider limits, because
        # simplification costs their fine shapes more.
        warn, fail = ((1.0, 3.0), (2.0, 6.0)) if label in names.cloth else ((2.0, 6.0), (5.0, 15.0))
        checks += [
            Check(f"template to scan, {label.name}: mean", found.pred_to_gt.mean, "mm", warn[0], fail[0]),
            Check(f"template to scan, {label.name}: p95", found.pred_to_gt.p95, "mm", warn[1], fail[1]),
        ]
    skin = face_labels == SKIN.id
    if skin.any():
        # Only vertices of faces that are skin on the scan itself, whose distance is the error of the body's fit.
        points = scan.vertices[np.unique(scan.faces[skin])]
        fit = float(point_to_surface(points, posed)[0].mean() * MM)
        checks.append(
            Check("scan's skin to the template: mean", fit, "mm", 5.0, 15.0, explanation="how well the body was fitted")
        )
    return Validation(forth, back), checks, {"template_vs_scan": result.as_dict()}


def _shared_volumes(template: Template) -> dict[str, dict[str, float]]:
    """The volumes that the body and each part, and any two parts share at rest, parts as cloth of one millimetre.

    Pairs of which one has no volume, such as a body with edges of three faces, are left out.
    """
    thickness = 1e-3  # metres, inward
    meshes = {name: template.part_mesh(name) for name in template.part_names}
    # Shared volumes are those of solids: the body's openings are closed by fans of faces, cloth gets a thickness.
    solids = {
        name: closed_mesh(mesh) if name == BODY_PART else thickened(mesh, inward=thickness)
        for name, mesh in meshes.items()
    }
    out = {}
    for a, b in combinations(solids, 2):
        # `interpenetration` refuses meshes that bound no volume.
        with suppress(InputError):
            out[f"{a}, {b}"] = interpenetration(solids[a], solids[b]).as_dict()
    return out


def _turned_faces(template: Template, posed: TriangleMesh, parts: Mapping[str, Part]) -> int:
    """Faces of the posed template's parts that face away from where they faced on the cleaned scan."""
    # A face lies within one part, so that its first corner tells the part.
    part_of_face = template.vertex_part[template.faces[:, 0]]
    turned = 0
    for name, part in parts.items():
        there = posed.submesh(part_of_face == template.part_names.index(name))[0]
        # Faces that close holes follow the scan's faces.
        scanned = there.face_cross[: part.mesh.face_count]
        # Twice the area times the normal of each face; a negative dot product means turned by more than 90 degrees.
        turned += int((np.einsum("ij,ij->i", part.mesh.face_cross, scanned) < 0).sum())
    return turned


def _lengthened(rest: TriangleMesh, posed: TriangleMesh, loop: np.ndarray) -> float:
    """Length of a border in the pose over that at rest."""
    return float(loop_lengths(posed, [loop])[0] / loop_lengths(rest, [loop])[0])


def _stretch(template: Template, params: BodyParams, names: list[str]) -> tuple[dict, float]:
    """Edge stretch of each worn part in each pose, and the largest p99.9 relative to what the pose asks for.

    A raised thigh lengthens the hem of a skirt, a loop around both legs, by half. Weights can only spread that over the
    cloth between the legs, so that the stretch is divided by that of the part's longest opening.
    """
    vertices = template.pose(params)
    out: dict[str, dict] = {}
    # The body's stretch is that of the model itself and says nothing about the template.
    for part in template.part_names:
        if part == BODY_PART:
            continue
        chosen = template.vertex_part[template.faces[:, 0]] == template.part_names.index(part)
        rest = template.mesh.submesh(chosen)[0]
        # Sorted, as `submesh` orders its vertices, so that `vertices[k][used]` matches the part's mesh.
        used = np.unique(template.faces[chosen])
        loops = border_loops(rest.faces)
        # An opening is a border loop: a hem, a cuff or a neckline.
        longest = loops[int(np.argmax(loop_lengths(rest, loops)))] if loops else None
        out[part] = {}
        for k, name in enumerate(names):
            posed = rest.with_vertices(vertices[k][used])
            report = stretch_report(rest, posed).as_dict()
            out[part][name] = {**report, "opening": 1.0 if longest is None else _lengthened(rest, posed, longest)}
    worst = max(
        # Division by at least 1: an opening that shrinks must not excuse stretched cloth.
        (pose["p999"] / max(pose["opening"], 1.0) for poses in out.values() for pose in poses.values()),
        default=1.0,
    )
    return out, worst
