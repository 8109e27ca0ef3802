"""Stages 00-30: a scan and parameters on disk become cleaned, labelled parts in the posed reference frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.runs.arrays import load_arrays, save_arrays
from pipelines.runs.checks import Check
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildConfig, BuildInputs
from smplxpp.body import load_body, load_params
from smplxpp.capture import read_cameras
from smplxpp.clean import PartsConfig, check_human_scale, clean_parts, convert_points, sanitize
from smplxpp.core.errors import InputError
from smplxpp.core.labels import SKIN, display_colors
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_io import read_raw_mesh, write_ply
from smplxpp.core.params import BodyParams
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.metrics import mesh_quality, point_to_surface
from smplxpp.segment import read_label_map, read_labels, segment_scan, vote_on_faces

MM = 1e3
GREY = 180


def load_scan(run: Path) -> tuple[TriangleMesh, np.ndarray, np.ndarray]:
    """The repaired scan of a run: mesh, (N, 3) colours, (N,) index of each vertex in the user's file."""
    arrays = load_arrays(run / "00_capture" / "scan.npz")["scan"]
    return TriangleMesh(arrays["vertices"], arrays["faces"]), arrays["colors"], arrays["source_vertex"]


def load_params_of_run(run: Path) -> BodyParams:
    """The parameters of the reference frame."""
    return load_params(run / "00_capture" / "params.npz")


def capture(folder: Path, inputs: BuildInputs, config: BuildConfig) -> StageOutput:
    """00: the scan in metres, +Y up, repaired; the frame's parameters."""
    raw = read_raw_mesh(inputs.scan)
    vertices = convert_points(raw.vertices, units=config.units, up=config.up)
    try:
        clean = sanitize(vertices, raw.faces)
    except InputError as error:
        raise InputError(
            f"scan {inputs.scan.name}: {error.subject}",
            expected=error.expected,
            received=error.received,
            remedy=error.remedy,
        ) from None
    check_human_scale(clean.mesh.vertices, subject=f"scan {inputs.scan.name}")
    colors = np.full((len(raw.vertices), 3), GREY, np.uint8) if raw.vertex_colors is None else raw.vertex_colors
    save_arrays(
        folder / "scan.npz",
        {
            "scan": {
                "vertices": clean.mesh.vertices,
                "faces": clean.mesh.faces,
                "colors": colors[clean.source_vertex],
                "source_vertex": clean.source_vertex,
                "source_face": clean.source_face,
            }
        },
    )
    params = load_params(inputs.params, body=load_body(inputs.body))
    params.frame(inputs.frame if len(params) > 1 else 0).save(folder / "params.npz")
    numbers = {"vertices": clean.mesh.vertex_count, "faces": clean.mesh.face_count, "repairs": str(clean.report)}
    return StageOutput(numbers=numbers)


def register(folder: Path, run: Path, inputs: BuildInputs) -> StageOutput:
    """10: the posed body of the given fit, and how well the scan agrees with it.

    A scan is never deeper inside the body than its noise: the share that is, tells a bad fit without any labels.
    """
    scan, _, _ = load_scan(run)
    posed = load_body(inputs.body).forward(load_params_of_run(run)).frame(0)
    np.savez(
        folder / "body.npz",
        vertices=posed.vertices,
        rest_vertices=posed.rest_vertices,
        joints=posed.joints,
        rest_joints=posed.rest_joints,
        posed_from_rest=posed.posed_from_rest,
    )
    body = TriangleMesh(posed.vertices, load_body(inputs.body).faces)
    rng = np.random.default_rng(0)
    sample = scan.vertices[np.sort(rng.permutation(scan.vertex_count)[:20_000])]
    distance = SignedDistanceField(body, solid=True).query(sample).distance * MM
    inside = float(np.mean(distance < -5.0))
    overlap = float(np.mean(np.abs(distance) < 250.0))
    checks = [
        Check(
            "share of the scan near the fitted body",
            overlap,
            "",
            0.98,
            0.8,
            higher_is_better=True,
            explanation="within 25 cm; low: another frame's parameters, or other units or axes",
        ),
        Check(
            "share of the scan inside the fitted body",
            inside,
            "",
            0.03,
            0.25,
            explanation="deeper than 5 mm; high: the fit is off by centimetres",
        ),
    ]
    if overlap < 0.2:
        raise InputError(
            "body parameters",
            expected="a body that stands in the scan",
            received=f"{100 * overlap:.0f} % of the scan within 25 cm of the body",
            remedy="check --frame, --units and --up, and that scan and parameters share one world",
        )
    return StageOutput(checks, {"distance_median_mm": float(np.median(distance))})


def segment(folder: Path, run: Path, inputs: BuildInputs) -> StageOutput:
    """20: a label, a confidence and a seen flag for every face."""
    scan, _, source_vertex = load_scan(run)
    if inputs.labels is None and inputs.label_maps:
        cameras = {camera.name: camera for camera in read_cameras(inputs.cameras)}
        missing = sorted(set(inputs.label_maps) - set(cameras))
        if missing:
            raise InputError(
                f"camera file {inputs.cameras.name}",
                expected=f"cameras {', '.join(missing)}",
                received=f"cameras {', '.join(sorted(cameras))}",
            )
        views = [
            (cameras[name], read_label_map(path, label_set=inputs.label_set))
            for name, path in inputs.label_maps.items()
        ]
        result = segment_scan(scan, votes=vote_on_faces(scan, views))
    else:
        raw = read_raw_mesh(inputs.scan)
        labels = read_labels(
            inputs.labels or inputs.scan,
            vertex_count=len(raw.vertices),
            face_count=len(raw.faces),
            label_set=inputs.label_set,
        )
        if len(labels) == len(raw.faces):
            source_face = load_arrays(run / "00_capture" / "scan.npz")["scan"]["source_face"]
            result = segment_scan(scan, face_labels=labels[source_face])
        else:
            result = segment_scan(scan, vertex_labels=labels[source_vertex])
    np.savez(folder / "labels.npz", face_labels=result.face_labels, confidence=result.confidence, seen=result.seen)
    write_ply(
        folder / "labels.ply",
        scan,
        vertex_colors=display_colors(vertex_labels(scan, result.face_labels)),
        face_properties={"label": result.face_labels, "confidence": result.confidence},
    )
    areas = scan.face_areas / scan.face_areas.sum()
    checks = [
        Check(
            "label confidence, mean",
            float(areas @ result.confidence),
            "",
            0.8,
            0.5,
            higher_is_better=True,
            explanation="area-weighted; how clearly the labels speak for the answer",
        ),
        Check(
            "share of the surface no label saw",
            float(areas @ ~result.seen),
            "",
            0.25,
            0.6,
            explanation="labelled from its neighbours alone",
        ),
    ]
    return StageOutput(checks, {"area_share": {str(k): float(areas[result.face_labels == k].sum()) for k in range(6)}})


def vertex_labels(mesh: TriangleMesh, face_labels: np.ndarray) -> np.ndarray:
    """(N,) a label for every vertex: that of its last face in order, for pictures and files."""
    out = np.full(mesh.vertex_count, SKIN.id, dtype=np.int64)
    out[mesh.faces] = face_labels[:, None]
    return out


def clean(folder: Path, run: Path, config: BuildConfig) -> StageOutput:
    """30: one clean mesh within its face budget for every part that is not skin."""
    scan, colors, _ = load_scan(run)
    with np.load(run / "20_segment" / "labels.npz") as labels:
        face_labels = labels["face_labels"]
    parts = clean_parts(scan, face_labels, config=PartsConfig(face_budgets=config.budgets), vertex_colors=colors)
    save_arrays(
        folder / "parts.npz",
        {
            name: {
                "vertices": part.mesh.vertices,
                "faces": part.mesh.faces,
                "label": np.int64(part.label),
                "source_vertex": part.source_vertex,
                "colors": part.vertex_colors,
            }
            for name, part in parts.items()
        },
    )
    checks, numbers = [], {}
    for name, part in parts.items():
        distance = point_to_surface(part.mesh.vertices, scan)[0] * MM
        quality = mesh_quality(part.mesh)
        numbers[name] = {"faces": part.mesh.face_count, "quality": quality, "report": part.report}
        checks += [
            Check(f"{name}: non-manifold edges", quality.nonmanifold_edges, "", 0, 0),
            Check(f"{name}: vertices to scan, p95", float(np.percentile(distance, 95)), "mm", 2.0, 5.0),
        ]
    return StageOutput(checks, numbers)
