"""Compare skin-weight transfer with the published method's reference implementation: seconds and errors.

    python -m benchmarks transfer_speed --captures DIR --peer CHECKOUT

All loose parts of a capture are one mesh of about 26k vertices. Each method runs `--repeats` times and the fastest
counts. The reference is timed as far as inpainting, and with the smoothing that its example ends with. CHECKOUT is your
copy of github.com/rin-23/RobustSkinWeightsTransferCode.
"""

from __future__ import annotations

import importlib.util
import time
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import igl
import numpy as np
import scipy.sparse as sp
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.support.people import CaptureTruth, find_captures, read_capture_truth
from benchmarks.support.results import store_results
from smplxpp.core import SkinWeights, TriangleMesh, concatenate_meshes
from smplxpp.transfer import TransferConfig, transfer_weights


@dataclass(frozen=True)
class Options:
    """captures: folder of captures with truth. peer: checkout of the reference implementation. repeats: of each."""

    captures: Path
    peer: Path
    repeats: int = 3


def compare_on(truth: CaptureTruth, peer: ModuleType, repeats: int) -> dict[str, dict]:
    """All loose parts of a capture as one mesh of many components, which is what the reference takes."""
    source = truth.body.mesh(truth.body.forward(truth.exact).vertices[0])
    target = concatenate_meshes([part.mesh for part in truth.parts.values()])
    authored = np.concatenate([part.weights for part in truth.parts.values()])
    weights = truth.body.weights

    def ours(config: TransferConfig):
        result = transfer_weights(source, weights, target, config=config)
        return result.dense(), result.matched

    def smoothed_peer():
        dense, matched = run_peer(peer, source, weights, target)
        return smooth_as_peer(peer, target, dense, matched), matched

    def by_part():
        # As a build does it: each part with the joints of its label.
        results = [
            transfer_weights(source, weights, part.mesh, config=TransferConfig.for_label(label))
            for label, part in truth.parts.items()
        ]
        return np.concatenate([r.dense() for r in results]), np.concatenate([r.matched for r in results])

    methods = {
        "reference": lambda: run_peer(peer, source, weights, target),
        "reference + smoothing": smoothed_peer,
        "paper's method": lambda: ours(TransferConfig.paper()),
        "ours": lambda: ours(TransferConfig()),
        "ours, part by part": by_part,
    }
    rows = {}
    for name, method in methods.items():
        seconds = []
        for _ in range(repeats):
            start = time.perf_counter()
            dense, matched = method()
            seconds.append(time.perf_counter() - start)
        lost = np.abs(dense.sum(axis=1) - 1.0) > 1e-6
        kept = SkinWeights.from_dense(np.where(lost[:, None], 1.0, dense)).dense()
        rows[name] = {
            "vertices": target.vertex_count,
            "unmatched": float(1 - np.mean(matched)),
            "seconds": min(seconds),
            "tv_mean": float(0.5 * np.abs(kept - authored).sum(axis=1).mean()),
            "tv_p95": float(np.percentile(0.5 * np.abs(kept - authored).sum(axis=1), 95)),
            "rows_not_summing_to_1": int(lost.sum()),
            "most_negative_weight": float(dense.min()),
        }
    for row in rows.values():
        row["times_reference"] = rows["reference"]["seconds"] / row["seconds"]
        row["times_with_smoothing"] = rows["reference + smoothing"]["seconds"] / row["seconds"]
    return rows


class _Igl:
    """libigl 2.6 under the names and signatures that the peer was written for; everything else passes through."""

    def __getattr__(self, name: str):
        return getattr(igl, name)

    @staticmethod
    def barycentric_coordinates_tri(p, a, b, c):
        return igl.barycentric_coordinates(*(np.ascontiguousarray(x) for x in (p, a, b, c)))

    @staticmethod
    def min_quad_with_fixed(q, b, known, values, _aeq, _beq, definite):
        n, columns = b.shape
        empty = sp.csc_matrix((0, n)), np.zeros((0, columns))
        return True, igl.min_quad_with_fixed(sp.csc_matrix(q), b, known, values, *empty, definite)


def load_peer(checkout: Path) -> ModuleType:
    """The peer's `src/utils.py` as a module."""
    spec = importlib.util.spec_from_file_location("rin23_utils", checkout / "src" / "utils.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.igl = _Igl()
    return module


def run_peer(
    peer: ModuleType, source: TriangleMesh, weights: np.ndarray, target: TriangleMesh
) -> tuple[np.ndarray, np.ndarray]:
    """Its matching and inpainting as its example calls them, thresholds included.

    Returns:
        (N, J) its weights as they come, (N,) matched.
    """
    v1, f1, v2, f2 = (np.array(x) for x in (source.vertices, source.faces, target.vertices, target.faces))
    n1, n2 = igl.per_vertex_normals(v1, f1), igl.per_vertex_normals(v2, f2)
    limit = (0.05 * igl.bounding_box_diagonal(v2)) ** 2
    matched, copied = peer.find_matches_closest_surface(v1, f1, n1, v2, f2, n2, weights, limit, 30)
    result, _ = peer.inpaint(v2, f2, copied, matched)
    return np.asarray(result), matched


def smooth_as_peer(peer: ModuleType, target: TriangleMesh, weights: np.ndarray, matched: np.ndarray) -> np.ndarray:
    """(N, J) its smoothing, the optional last step of its example, with the example's settings."""
    limit = 0.05 * igl.bounding_box_diagonal(np.array(target.vertices))
    smoothed, _ = peer.smooth(
        target.vertices, target.faces, weights, matched, limit, num_smooth_iter_steps=10, smooth_alpha=0.2
    )
    return smoothed


def main(options: Options) -> None:
    console, figures = Console(width=130), {}
    peer = load_peer(options.peer)
    for folder in find_captures(options.captures):
        rows = figures[folder.name] = compare_on(read_capture_truth(folder, cloth_faces=23_000), peer, options.repeats)
        table = Table(title=folder.name)
        for column in ("method", *next(iter(rows.values()))):
            table.add_column(column)
        for name, row in rows.items():
            table.add_row(name, *(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()))
        console.print(table)
    store_results("transfer_speed", "python -m benchmarks transfer_speed --captures DIR --peer CHECKOUT", figures)


if __name__ == "__main__":
    main(tyro.cli(Options))
