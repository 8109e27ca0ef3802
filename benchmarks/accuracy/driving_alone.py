"""Drive a template built from a bare scan, beside one built with true parameters and labels.

    python -m benchmarks driving_alone --captures DIR [--keep DIR] [--names woman_casual ...]

Each capture's scan is built three times: alone (units, body and labels found), with exact parameters and labels found,
and with exact parameters and true labels. Every visible vertex of a template is driven twice: by its template, in hard
poses on the identity that it has, and by the authored weights of the true surface that it lies nearest to, on the true
identity. The distance between the two is the error, mm. Where a template and the truth differ in the reference pose
already (a label that is wrong, a body of another shape), the error says it.
"""

from __future__ import annotations

import json
import tempfile
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import igl
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.support.capture_truth import find_captures
from benchmarks.support.results import RESULTS, store_results
from pipelines.commands.build import Build
from pipelines.commands.options import OptionalPath
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.layout import TEMPLATE, VALIDATE_STAGE
from smplxpp.body import load_body, load_params
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.core import BodyParams, GeometryWarning, TriangleMesh
from smplxpp.core.files.array_file import read_arrays
from smplxpp.raster import outer_visible_points
from smplxpp.skinning import UnposeConfig, skin, unpose
from smplxpp.template.template import Template

_ANY_DETERMINANT = UnposeConfig(warn_below=-np.inf, fail_below=-np.inf)
_BELONGS = 0.02
"""Metres from the true surface within which a vertex of a template belongs to it; others are counted apart."""
_PARTS = ("body", "upper", "lower", "shoes", "hair")


@dataclass(frozen=True)
class DrivingAlone:
    """Build, drive and compare."""

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
            store_results("driving_alone", "python -m benchmarks driving_alone --captures DIR", figures)


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
    tyro.cli(DrivingAlone).run()
