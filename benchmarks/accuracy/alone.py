"""Measure what photographs alone or a bare scan give: each step of a run against the truth, and the template driven.

smplxpp build RUN --capture PHOTOGRAPHS; smplxpp train RUN --capture PHOTOGRAPHS --preset cpu
smplxpp evaluate RUN --capture PHOTOGRAPHS
python -m benchmarks alone photographs --run RUN --truth CAPTURE [--name NAME]
python -m benchmarks alone driven --captures DIR [--keep DIR] [--names woman_casual ...]
"""

from __future__ import annotations

import json
import tempfile
import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import igl
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from benchmarks.accuracy.registration import bare_and_under
from benchmarks.accuracy.training import evaluation_conditions, evaluation_figures
from benchmarks.support.people import find_captures
from benchmarks.support.results import RESULTS, store_results
from pipelines.commands.build import Build
from pipelines.commands.options import OptionalPath
from pipelines.runs.artefacts import load_params_of_run, load_scan, load_scan_labels, load_stacked_params
from pipelines.runs.layout import BUILD_STAGES, EVALUATION, MODEL_STAGES, REGISTERED_PARAMS, TEMPLATE, VALIDATE_STAGE
from pipelines.runs.stage import read_manifest
from smplxpp.body import BodyModel, load_body, load_params
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.capture import open_capture
from smplxpp.core import LABELS, BodyParams, GeometryWarning, TriangleMesh
from smplxpp.core.files.array_file import read_arrays
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.metrics.pose_error import pose_error
from smplxpp.raster import outer_visible_points
from smplxpp.segment import read_labels
from smplxpp.skinning import UnposeConfig, skin, unpose
from smplxpp.template.template import Template

COMMAND = (
    "smplxpp build, train --preset cpu, evaluate; python -m benchmarks alone photographs --run RUN --truth CAPTURE"
)
_NEAR = 0.015
"""Metres from the true scan within which a face has a true label."""


@dataclass(frozen=True)
class PhotographsAlone:
    """Measure each step of a run from photographs, cameras and masks alone against the truth.

    PHOTOGRAPHS is a folder with no more than `rgbs/`, `masks/`, the cameras and, in capture.json, what is held out,
    of the capture CAPTURE, whose truth is looked at in measuring alone. PSNR stands beside that of the stored
    trainings of the same capture on `exact` and on `tracked` inputs.
    """

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


_ANY_DETERMINANT = UnposeConfig(warn_below=-np.inf, fail_below=-np.inf)
_BELONGS = 0.02
"""Metres from the true surface within which a vertex of a template belongs to it; others are counted apart."""
_PARTS = ("body", "upper", "lower", "shoes", "hair")


@dataclass(frozen=True)
class DrivingAlone:
    """Drive a template built from a bare scan, beside one built with true parameters and labels.

    Each capture's scan is built three times: alone (units, body and labels found), with exact parameters and labels
    found, and with exact parameters and true labels. Every visible vertex of a template is driven twice: by its
    template, in hard poses on the identity that it has, and by the authored weights of the true surface that it lies
    nearest to, on the true identity. The distance between the two is the error, mm. Where a template and the truth
    differ in the reference pose already (a label that is wrong, a body of another shape), the error says it.
    """

    captures: Path
    """Folder of captures with truth."""
    names: tuple[str, ...] = ()
    """Those that are measured; all by default."""
    keep: OptionalPath = None
    """Folder of the runs, which are not built again where they stand; a temporary one by default."""
    builds: tuple[str, ...] = ()
    """These of the three builds, as the table calls them; the others' rows stay as they are stored. All by default."""
    store: bool = True
    """Write benchmarks/results/driving_alone.json."""

    def run(self) -> None:
        """Print and store the figures."""
        stored = RESULTS / "driving_alone.json"
        figures: dict[str, dict] = json.loads(stored.read_text())["figures"] if self.builds else {}
        with tempfile.TemporaryDirectory() as scratch:
            for folder in find_captures(self.captures):
                if self.names and folder.name not in self.names:
                    continue
                truth = _Truth.of(folder)
                rows = figures.get(folder.name, {})
                for words, build in _builds(folder, (self.keep or Path(scratch)) / folder.name).items():
                    if self.builds and words not in self.builds:
                        continue
                    build.run()
                    rows[words] = truth.errors(build.out)
                figures[folder.name] = rows
                _print(folder.name, rows)
        if self.store:
            store_results("driving_alone", "python -m benchmarks alone driven --captures DIR", figures)


def _builds(folder: Path, runs: Path) -> dict[str, Build]:
    scan, params = folder / "scans" / "scan_000000.ply", folder / "params" / "000000.npz"
    params = params if params.exists() else folder / "params" / "params.npz"
    labels = folder / "scans" / "scan_000000_labels.npz"
    plain = {"scan": scan, "no_report": True, "json": True, "until_stage": VALIDATE_STAGE}
    return {
        "everything found": Build(run_folder=runs / "alone", label_source="body", **plain),
        "exact parameters, labels found": Build(
            run_folder=runs / "labels", params=params, label_source="body", **plain
        ),
        "everything true": Build(run_folder=runs / "true", params=params, labels=labels, label_set="capture", **plain),
    }


@dataclass(frozen=True, eq=False)
class _Truth:
    """The true layers of a capture's first frame.

    Attributes:
        mesh: all layers that can be seen. part: of each face. weights: of vertices. exact: parameters.
    """

    mesh: TriangleMesh
    part: np.ndarray
    weights: np.ndarray
    exact: BodyParams

    @staticmethod
    def of(folder: Path) -> _Truth:
        topology = read_arrays(folder / "geometry" / "topology.npz", subject="truth")
        posed = read_arrays(folder / "geometry" / "frame_000000.npz", subject="truth")["verts"].astype(np.float64)
        names = [str(name) for name in topology["part_names"]]
        shown = ~topology["face_hidden"].astype(bool) & np.isin(
            topology["face_part"], [k for k, name in enumerate(names) if name in _PARTS]
        )
        part = np.array([_PARTS.index(name) if name in _PARTS else -1 for name in names])
        single = folder / "params" / "000000.npz"
        exact = load_params(single if single.exists() else folder / "params" / "params.npz").frame(0)
        mesh = TriangleMesh(posed, topology["faces"][shown].astype(np.int64))
        return _Truth(mesh, part[topology["face_part"][shown]], topology["weights"].astype(np.float64), exact)

    def errors(self, run: Path) -> dict[str, dict[str, float]]:
        """Mean, 95th and 99th percentile by true part over all hard poses, mm; the worst pose of each part."""
        template, found, body = Template.load(run / TEMPLATE), load_params_of_run(run), load_body()
        # Compare visible vertices near the true surface only: others are not on the person, and are counted at the end.
        here = template.pose(found)[0]
        visible = outer_visible_points(template.mesh.with_vertices(here), here, tolerance=0.002)
        squared, face, closest = igl.point_mesh_squared_distance(here, self.mesh.vertices, self.mesh.faces)
        used = visible & (squared < _BELONGS**2)
        # The true place in a pose: undo the reference pose by the authored weights of the nearest true point, then
        # pose by the same weights. Any difference left is of weights and fit.
        weights = self._weights_at(face[used], closest[used])
        true_reference = body.forward(self.exact).posed_from_rest[0]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GeometryWarning)
            rest = unpose(here[used], weights, true_reference, config=_ANY_DETERMINANT).vertices
        # Without translation, because the fit's own would count in every pose.
        still = {"transl": np.zeros((1, 3))}
        theirs = body.forward(stress_poses(replace(self.exact, **still))).posed_from_rest
        driven = template.pose(stress_poses(replace(found, **still)))[:, used]
        expected = np.stack([skin(rest, weights, transforms) for transforms in theirs])
        error = 1e3 * np.linalg.norm(driven - expected, axis=2)
        out: dict[str, dict[str, float]] = {}
        for k, name in enumerate((*_PARTS, "all")):
            own = self.part[face[used]] == k if name != "all" else np.ones(int(used.sum()), dtype=bool)
            if own.any():
                values, poses = error[:, own], error[:, own].mean(axis=1)
                p95, p99 = np.percentile(values, [95, 99])
                worst = int(np.argmax(poses))
                out[name] = {"mean": float(values.mean()), "p95": float(p95), "p99": float(p99)}
                out[name] |= {"worst_pose": list(STRESS_POSES)[worst], "worst_pose_mean": float(poses[worst])}
        out["all"]["share_off_the_true_surface"] = float((visible & ~used).sum() / max(visible.sum(), 1))
        return out

    def _weights_at(self, face: np.ndarray, closest: np.ndarray) -> np.ndarray:
        corners = self.mesh.faces[face]
        ends = (np.ascontiguousarray(self.mesh.vertices[corners[:, k]]) for k in range(3))
        barycentric = np.clip(np.nan_to_num(igl.barycentric_coordinates(closest, *ends), nan=1 / 3), 0, None)
        barycentric /= barycentric.sum(axis=1, keepdims=True)
        at = np.einsum("nk,nkj->nj", barycentric, self.weights[corners])
        return at / at.sum(axis=1, keepdims=True)


def _print(name: str, rows: dict[str, dict]) -> None:
    table = Table(title=f"{name}: driven in hard poses, mean / p95 / p99 mm, and the worst pose's mean")
    table.add_column("built with", no_wrap=True)
    for part in next(iter(rows.values())):
        table.add_column(part, justify="right")
    for words, row in rows.items():
        cells = [
            f"{c['mean']:.1f} / {c['p95']:.0f} / {c['p99']:.0f} ({c['worst_pose_mean']:.1f})" for c in row.values()
        ]
        table.add_row(words, *cells)
    Console(width=190).print(table)


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"photographs": PhotographsAlone, "driven": DrivingAlone}).run()
