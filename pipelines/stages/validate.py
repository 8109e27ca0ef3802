"""Stage 65: the template against the scan it came from, and under poses that try its skinning."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from pipelines.runs.artefacts import load_params_of_run, load_parts, load_scan, load_scan_labels, save_arrays
from pipelines.runs.layout import TEMPLATE
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildConfig, BuildContext
from pipelines.stages.completeness import completeness_checks
from pipelines.stages.motion import motion_of_build
from pipelines.stages.photographs import photograph_checks
from smplxpp.body.stress_poses import STRESS_POSES, stress_poses
from smplxpp.clean import loop_lengths, thickened
from smplxpp.core.checks import Check
from smplxpp.core.errors import InputError
from smplxpp.core.labels import CLOTH_LABELS, LABELS, SKIN
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.solids import closed_mesh
from smplxpp.core.spread import spread
from smplxpp.core.topology import border_loops
from smplxpp.metrics import (
    CompareConfig,
    DirectedDistances,
    directed_distances,
    interpenetration,
    mesh_quality,
    point_to_surface,
    stretch_report,
    summarize,
)
from smplxpp.metrics.conventions import convention_named
from smplxpp.metrics.distance import MM
from smplxpp.template.template import BODY_PART, Template

MOTION_FRAMES = 12
CLOTH = 1e-3
"""Thickness of the cloth, inward, whose volume is measured; metres."""


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write distances to the scan in the reference pose, flips, and stretch under hard poses and the motion."""
    template = Template.load(build.run / TEMPLATE)
    scan, colors, _ = load_scan(build.run)
    face_labels = load_scan_labels(build.run, scan.face_count)
    reference = load_params_of_run(build.run)
    posed = template.mesh.with_vertices(template.pose(reference)[0])
    checks, numbers, back = _against_scan(folder, posed, template.vertex_labels, scan, face_labels, build.config)
    whole, numbers["completeness"] = completeness_checks(template, reference, scan, face_labels, back)
    checks += whole
    seen, numbers["photographs"] = photograph_checks(template, reference, scan, colors, build.inputs)
    checks += seen
    quality = {name: mesh_quality(template.part_mesh(name)) for name in template.part_names}
    numbers["quality"] = {name: q.as_dict() for name, q in quality.items()}
    numbers["shared_volume"] = _shared_volumes(template)
    flips = _flips(template, posed, build.run)
    checks.append(Check("faces of the parts turned over against the cleaned scan", flips, "", 0, 0))
    poses = {"hard poses": stress_poses(reference)}
    motion = motion_of_build(build.run, build.inputs)
    if motion is not None:
        poses["motion"] = motion.select(spread(range(len(motion)), MOTION_FRAMES))
    for title, params in poses.items():
        names = list(STRESS_POSES) if title == "hard poses" else [f"frame {k}" for k in range(len(params))]
        numbers[title], worst = _stretch(template, params, names)
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
    return StageOutput(checks, numbers)


def _against_scan(
    folder: Path,
    posed: TriangleMesh,
    vertex_labels: np.ndarray,
    scan: TriangleMesh,
    face_labels: np.ndarray,
    config: BuildConfig,
) -> tuple[list[Check], dict, DirectedDistances]:
    measured = partial(
        directed_distances, samples=config.samples, seed=config.seed, config=CompareConfig(visible_only=True)
    )
    forth = measured(posed, scan, source_labels=vertex_labels, target_labels=face_labels)
    back = measured(scan, posed, source_labels=face_labels, target_labels=vertex_labels)
    result = summarize(forth, back, convention=convention_named("smplxpp"), threshold_mm=5.0)
    save_arrays(
        folder / "errors.npz",
        {
            name: {"distance_mm": (d.distance * MM).astype(np.float32), "label": np.asarray(d.label).astype(np.int8)}
            for name, d in (("template_to_scan", forth), ("scan_to_template", back))
        },
    )
    checks = []
    for label in LABELS:
        found = result.labels.get(label.name)
        if found is None or found.pred_to_gt is None or label == SKIN:
            continue
        warn, fail = ((1.0, 3.0), (2.0, 6.0)) if label in CLOTH_LABELS else ((2.0, 6.0), (5.0, 15.0))
        checks += [
            Check(f"template to scan, {label.name}: mean", found.pred_to_gt.mean, "mm", warn[0], fail[0]),
            Check(f"template to scan, {label.name}: p95", found.pred_to_gt.p95, "mm", warn[1], fail[1]),
        ]
    skin = face_labels == SKIN.id
    if skin.any():
        points = scan.vertices[np.unique(scan.faces[skin])]
        fit = float(point_to_surface(points, posed)[0].mean() * MM)
        checks.append(
            Check("scan's skin to the template: mean", fit, "mm", 5.0, 15.0, explanation="how well the body was fitted")
        )
    return checks, {"template_vs_scan": result.as_dict()}, back


def _shared_volumes(template: Template) -> dict[str, dict[str, float]]:
    """The volumes that the body and each part, and any two parts share at rest, parts as cloth of `CLOTH` metres.

    Pairs of which one has no volume, such as a body with edges of three faces, are left out.
    """
    solids = {name: template.part_mesh(name) for name in template.part_names}
    solids = {
        name: closed_mesh(mesh) if name == BODY_PART else thickened(mesh, inward=CLOTH) for name, mesh in solids.items()
    }
    out = {}
    for a, b in combinations(solids, 2):
        with suppress(InputError):
            out[f"{a}, {b}"] = interpenetration(solids[a], solids[b]).as_dict()
    return out


def _flips(template: Template, posed: TriangleMesh, run: Path) -> int:
    """Faces of the posed template's parts that face away from where they faced on the cleaned scan."""
    part_of_face = template.vertex_part[template.faces[:, 0]]
    turned = 0
    for name, (mesh, _) in load_parts(run).items():
        there = posed.submesh(part_of_face == template.part_names.index(name))[0]
        # What was darned comes behind the scan's faces.
        scanned = there.face_cross[: mesh.face_count]
        turned += int((np.einsum("ij,ij->i", mesh.face_cross, scanned) < 0).sum())
    return turned


def _lengthened(rest: TriangleMesh, posed: TriangleMesh, loop: np.ndarray) -> float:
    """Length of a border in the pose over that at rest."""
    return float(loop_lengths(posed, [loop])[0] / loop_lengths(rest, [loop])[0])


def _stretch(template: Template, params: BodyParams, names: list[str]) -> tuple[dict, float]:
    """Edge stretch of each worn part in each pose, and the largest p99.9 over what the pose asks for.

    A raised thigh pulls the hem of a skirt, a loop around both legs, to half its length more. No weights can undo that,
    and they can only spread it over the cloth between the legs; what a gate can tell is cloth that tears beyond.
    """
    vertices = template.pose(params)
    out: dict[str, dict] = {}
    for part in template.part_names:
        if part == "body":
            continue
        chosen = template.vertex_part[template.faces[:, 0]] == template.part_names.index(part)
        rest = template.mesh.submesh(chosen)[0]
        used = np.unique(template.faces[chosen])
        loops = border_loops(rest.faces)
        longest = loops[int(np.argmax(loop_lengths(rest, loops)))] if loops else None
        out[part] = {}
        for k, name in enumerate(names):
            posed = rest.with_vertices(vertices[k][used])
            report = stretch_report(rest, posed).as_dict()
            out[part][name] = {**report, "opening": 1.0 if longest is None else _lengthened(rest, posed, longest)}
    worst = max(
        (pose["p999"] / max(pose["opening"], 1.0) for poses in out.values() for pose in poses.values()), default=1.0
    )
    return out, worst
