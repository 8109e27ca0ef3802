"""Compare parts driven by transferred skin weights with the same parts driven by their authored weights.

    python -m benchmarks driving --captures DIR [--peer CHECKOUT] [--runs DIR] [--out NAME]

The reference scan is cut by its true labels into the default parts; weights are transferred from the posed open body,
the parts are unposed with them, and posed again: in hard poses and in the capture's own motion. Errors are distances in
mm to the same part unposed (exact parameters) and posed with the authored weights, which are those of the closest point
of the true layer. With noisy parameters the body, the unposing and the driving skeleton are a tracker's, as they are;
with `--runs`, a folder of runs named as the captures, also those that `smplxpp build --protocol tracked` registered.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from benchmarks.peers.transfer_speed import load_peer, run_peer
from benchmarks.support.people import CaptureTruth, TruePart, find_captures, read_capture_truth
from benchmarks.support.results import store_results
from pipelines.runs.artefacts import load_params_of_run
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.core import BodyParams, GeometryWarning, SkinWeights, TriangleMesh
from smplxpp.metrics import edge_stretch
from smplxpp.skinning import UnposeConfig, skin, unpose
from smplxpp.transfer import TransferConfig, transfer_weights
from smplxpp.transfer.correspond import closest_points

_ANY_DETERMINANT = UnposeConfig(warn_below=-np.inf, fail_below=-np.inf)  # baselines may fold a vertex: measure it

Method = Callable[[TriangleMesh, np.ndarray, TriangleMesh, str], np.ndarray]


@dataclass(frozen=True)
class Options:
    """captures: folder of captures with truth. peer: checkout of the reference implementation. runs: folder of runs
    built under the protocol `tracked`, each named as its capture. out: name of the stored results. motion_frames:
    frames of the capture's motion, evenly spread."""

    captures: Path
    peer: Path | None = None
    runs: Path | None = None
    out: Path = Path("driving")
    motion_frames: int = 8


def nearest_vertex(source: TriangleMesh, weights: np.ndarray, target: TriangleMesh, label: str) -> np.ndarray:
    """Weights of the nearest source vertex."""
    return weights[cKDTree(source.vertices).query(target.vertices)[1]]


def nearest_point(source: TriangleMesh, weights: np.ndarray, target: TriangleMesh, label: str) -> np.ndarray:
    """Weights of the nearest source point."""
    return closest_points(source, target).interpolate(source, weights)


def methods(peer: Path | None) -> dict[str, Method]:
    """Baselines, the published method, ours, and ours with one ingredient each."""

    def configured(config: TransferConfig, *, by_label: bool = True) -> Method:
        def run(source: TriangleMesh, weights: np.ndarray, target: TriangleMesh, label: str) -> np.ndarray:
            used = TransferConfig.for_label(label, base=config) if by_label else config
            return transfer_weights(source, weights, target, config=used).dense()

        return run

    table: dict[str, Method] = {"nearest vertex": nearest_vertex, "nearest point": nearest_point}
    if peer is not None:
        module = load_peer(peer)
        table["reference code"] = lambda s, w, t, label: SkinWeights.from_dense(run_peer(module, s, w, t)[0]).dense()
    paper, full = TransferConfig.paper(), TransferConfig()
    return table | {
        "paper's method": configured(paper, by_label=False),
        "paper + regions": configured(paper),
        "extension only": configured(replace(paper, falloff=full.falloff)),
        "smoothing only": configured(replace(full, falloff=None, unmatched="nearest")),
        "ours, no labels": configured(full, by_label=False),
        "ours, 0.1": configured(TransferConfig.restricted()),
        "ours": configured(full),
    }


def driven_poses(truth: CaptureTruth, identity: BodyParams, motion_frames: int) -> dict[str, np.ndarray]:
    """Name -> (F, J, 4, 4) transforms of the poses on an identity; the root stays at the origin in hard poses."""
    hard = stress_poses(replace(identity, transl=np.zeros((1, 3))))
    hard_transforms = truth.body.forward(hard).posed_from_rest
    out = {name: hard_transforms[[k]] for k, name in enumerate(STRESS_POSES)}
    if len(truth.motion) > 1:
        chosen = truth.motion.select(np.linspace(0, len(truth.motion) - 1, motion_frames).round().astype(int))
        chosen = replace(chosen, betas=np.repeat(identity.betas, len(chosen), axis=0))
        out["own motion"] = truth.body.forward(chosen).posed_from_rest
    return out


def judge(
    truth: CaptureTruth, part: TruePart, dense: np.ndarray, params: BodyParams, motion_frames: int
) -> dict[str, dict[str, float]]:
    """Errors of one part's weights by quantity; mm except the weights' total variation and the stretch."""
    vertices = part.mesh.vertices
    reference = truth.body.forward(params).posed_from_rest[0]
    rest = unpose(vertices, dense, reference, config=_ANY_DETERMINANT).vertices
    true_reference = truth.body.forward(truth.exact).posed_from_rest[0]
    true_rest = unpose(vertices, part.weights, true_reference, config=_ANY_DETERMINANT).vertices
    rows = {
        "weights (TV)": _summary(0.5 * np.abs(dense - part.weights).sum(axis=1)),
        "T-pose": _summary(1e3 * np.linalg.norm(rest - part.rest_vertices, axis=1)),
    }
    ours = driven_poses(truth, params, motion_frames)
    theirs = driven_poses(truth, truth.exact, motion_frames)
    for name, transforms in ours.items():
        posed = np.stack([skin(rest, dense, g) for g in transforms])
        expected = np.stack([skin(true_rest, part.weights, g) for g in theirs[name]])
        rows[name] = _summary(1e3 * np.linalg.norm(posed - expected, axis=2).ravel())
        stretch = np.concatenate([edge_stretch(part.mesh, part.mesh.with_vertices(p)) for p in posed])
        rows[name]["stretch_p999"] = float(np.nanpercentile(stretch, 99.9))
    return rows


def _summary(values: np.ndarray) -> dict[str, float]:
    p95, p99 = np.percentile(values, [95, 99])
    return {"mean": float(values.mean()), "p95": float(p95), "p99": float(p99)}


def run_capture(
    truth: CaptureTruth, table: dict[str, Method], motion_frames: int, registered: BodyParams | None
) -> dict:
    """figures[params][part][method][quantity] = {mean, p95, p99, (stretch_p999)}."""
    figures: dict = {}
    kinds = {"exact": truth.exact, "tracked, registered": registered, "noisy": truth.noisy}
    for kind, params in kinds.items():
        if params is None:
            continue
        source = truth.body.mesh(truth.body.forward(params).vertices[0])
        for label, part in truth.parts.items():
            for name, method in table.items():
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", GeometryWarning)
                    dense = method(source, truth.body.weights, part.mesh, label)
                rows = judge(truth, part, dense, params, motion_frames)
                figures.setdefault(kind, {}).setdefault(label, {})[name] = rows
    return figures


def print_tables(console: Console, name: str, figures: dict) -> None:
    """One table a part and kind of parameters: mean / p95 / p99, and in brackets the stretch's p99.9."""
    for kind, parts in figures.items():
        for label, rows in parts.items():
            table = Table(title=f"{name}, {label}, {kind} parameters: mean / p95 / p99 mm (edge stretch p99.9)")
            table.add_column("method", no_wrap=True)
            for quantity in next(iter(rows.values())):
                table.add_column(quantity, justify="right")
            for method, row in rows.items():
                table.add_row(method, *(_cell(quantity, cell) for quantity, cell in row.items()))
            console.print(table)


def _cell(quantity: str, cell: dict[str, float]) -> str:
    digits = 3 if "TV" in quantity else 1
    text = f"{cell['mean']:.{digits}f} / {cell['p95']:.{digits - 1}f} / {cell['p99']:.{digits - 1}f}"
    return text + (f" ({cell['stretch_p999']:.1f})" if "stretch_p999" in cell else "")


def main(options: Options) -> None:
    console, table, figures = Console(width=190), methods(options.peer), {}
    for folder in find_captures(options.captures):
        truth = read_capture_truth(folder)
        run = None if options.runs is None else options.runs / truth.name
        registered = None if run is None or not run.is_dir() else load_params_of_run(run)
        figures[truth.name] = run_capture(truth, table, options.motion_frames, registered)
        print_tables(console, truth.name, figures[truth.name])
    options_given = (" --peer CHECKOUT" if options.peer else "") + (" --runs DIR" if options.runs else "")
    path = store_results(options.out.stem, f"python -m benchmarks driving --captures DIR{options_given}", figures)
    console.print(f"stored in {path}")


if __name__ == "__main__":
    main(tyro.cli(Options))
