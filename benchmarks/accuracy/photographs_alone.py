"""Measure each step of a run from photographs, cameras and masks alone against the truth.

    smplxpp build RUN --capture PHOTOGRAPHS; smplxpp train RUN --capture PHOTOGRAPHS --preset cpu
    smplxpp evaluate RUN --capture PHOTOGRAPHS
    python -m benchmarks photographs_alone --run RUN --truth CAPTURE [--name NAME]

PHOTOGRAPHS is a folder with no more than `rgbs/`, `masks/`, the cameras and, in capture.json, what is held out, of
the capture CAPTURE, whose truth is looked at in measuring alone. PSNR stands beside that of the stored trainings of the
same capture on `exact` and on `tracked` inputs.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from scipy.spatial import cKDTree

from benchmarks.accuracy.registration import bare_and_under
from benchmarks.accuracy.training import evaluation_conditions, evaluation_figures
from benchmarks.support.results import RESULTS, store_results
from pipelines.runs.artefacts import load_params_of_run, load_scan, load_scan_labels, load_stacked_params
from pipelines.runs.layout import BUILD_STAGES, EVALUATION, MODEL_STAGES, REGISTERED_PARAMS
from pipelines.runs.stage import read_manifest
from smplxpp.body import BodyModel, load_body, load_params
from smplxpp.capture import open_capture
from smplxpp.core import LABELS, BodyParams
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.metrics.pose_error import pose_error
from smplxpp.segment import read_labels

COMMAND = (
    "smplxpp build, train --preset cpu, evaluate; python -m benchmarks photographs_alone --run RUN --truth CAPTURE"
)
_NEAR = 0.015
"""Metres from the true scan within which a face has a true label."""


@dataclass(frozen=True)
class PhotographsAlone:
    """Read a run and hold it against the truth."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Run that was built, trained and evaluated."""
    truth: Path
    """The capture that the photographs are of."""
    name: str = ""
    """Name in the result; the capture's by default."""

    def run(self) -> None:
        """Print and store the figures."""
        body, run, name = load_body(), self.run_folder, self.name or self.truth.resolve().name
        exact = load_params(self.truth / "params" / "params.npz", body=body)
        manifests = {stage: read_manifest(run / stage) for stage in (*BUILD_STAGES, *MODEL_STAGES)}
        figures: dict[str, Any] = {
            "seconds": {stage: one["seconds"] for stage, one in manifests.items() if one is not None},
            "checks": [
                {"stage": stage, **check}
                for stage, one in manifests.items()
                for check in (one or {}).get("checks", ())
                if check["status"] != "pass"
            ],
            "body_of_the_reference_frame": body_error(body, load_params_of_run(run), exact.frame(0)),
            "bodies": bodies(body, run, self.truth, exact),
            "labels": label_accuracy(run, self.truth),
        }
        if (run / EVALUATION).is_file():
            figures |= {**evaluation_conditions(run / EVALUATION), "evaluation": evaluation_figures(run / EVALUATION)}
            figures["beside"] = beside(name)
        print(json.dumps(figures, indent=1))
        store_results(f"photographs_alone_{name}", COMMAND, figures)


def body_error(body: BodyModel, found: BodyParams, true: BodyParams) -> dict[str, float]:
    """Mean distance of vertices and of the 22 joints of the body in one frame, mm."""
    a, b = body.forward(found).frame(0), body.forward(true).frame(0)
    vertices = np.linalg.norm(a.vertices - b.vertices, axis=1)
    joints = np.linalg.norm(a.joints - b.joints, axis=1)[:22]
    return {"vertices_mm": float(1e3 * vertices.mean()), "joints_mm": float(1e3 * joints.mean())}


def bodies(body: BodyModel, run: Path, capture: Path, exact: BodyParams) -> dict[str, Any]:
    """Errors of all frames, training and held-out ones apart."""
    frames, found = load_stacked_params(run / REGISTERED_PARAMS)
    train = np.isin(frames, open_capture(capture).splits.train_frames)
    covered = bare_and_under(capture, body.vertex_count)[1]
    out = {}
    for name, rows in (("training", np.flatnonzero(train)), ("held_out", np.flatnonzero(~train))):
        if len(rows):
            true = exact.select(np.asarray(frames)[rows])
            out[name] = asdict(pose_error(found.select(rows), true, body, covered))
    return out


def label_accuracy(run: Path, capture: Path) -> dict[str, Any]:
    """Share of the surface, by area, that has the label of the true scan's nearest vertex: whole, and by true label."""
    path = capture / "scans" / "scan_000000.ply"
    raw, (mesh, _, _) = read_raw_mesh(path), load_scan(run)
    true = read_labels(
        path.with_name("scan_000000_labels.npz"),
        vertex_count=len(raw.vertices),
        face_count=len(raw.faces),
        label_set="capture",
    )
    distance, nearest = cKDTree(raw.vertices).query(mesh.face_centers)
    known = (distance < _NEAR) & (true[nearest] >= 0)
    right = load_scan_labels(run, mesh.face_count) == true[nearest]
    areas = mesh.face_areas
    by_label = {}
    for label in LABELS:
        own = known & (true[nearest] == label.id)
        if own.any():
            by_label[label.name] = float(areas[own] @ right[own] / areas[own].sum())
    return {
        "right": float(areas[known] @ right[known] / areas[known].sum()),
        "by_label": by_label,
        "share_near_the_true_surface": float(areas[known].sum() / areas.sum()),
    }


def beside(name: str) -> dict[str, Any]:
    """The student's images of the stored trainings of the same capture."""
    out = {}
    for protocol, suffix in (("exact", ""), ("tracked", "_tracked")):
        path = RESULTS / f"training_{name}_cpu{suffix}.json"
        if path.is_file():
            out[protocol] = json.loads(path.read_text())["figures"]["evaluation"]["student"]["views"]
    return out


if __name__ == "__main__":
    tyro.cli(PhotographsAlone).run()
