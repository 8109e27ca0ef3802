"""Speed and errors of skin-weight transfer beside the published method's reference implementation, in one run.

    python -m benchmarks.transfer_speed --captures DIR --peer CHECKOUT

The loose parts of all captures (default budgets) are transferred one after the other by each method; each part is timed
`--repeats` times and the fastest counts. CHECKOUT is your copy of github.com/rin-23/RobustSkinWeightsTransferCode.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.capture_truth import CaptureTruth, find_captures, read_capture_truth
from benchmarks.machine import store_results
from benchmarks.rin23 import load_peer, run_peer
from smplxpp.core.mesh import concatenate_meshes
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.transfer import TransferConfig, transfer_weights


@dataclass(frozen=True)
class Options:
    """captures: folder of captures with truth. peer: checkout of the reference implementation. repeats: of each."""

    captures: Path
    peer: Path
    repeats: int = 3


def compare_on(truth: CaptureTruth, peer: object, repeats: int) -> dict[str, dict]:
    """All loose parts of a capture as one mesh of many components, which is what the reference takes."""
    source = truth.body.mesh(truth.body.forward(truth.exact).vertices[0])
    target = concatenate_meshes([part.mesh for part in truth.parts.values()])
    authored = np.concatenate([part.weights for part in truth.parts.values()])
    weights = truth.body.weights

    def ours(config: TransferConfig):
        result = transfer_weights(source, weights, target, config=config)
        return result.dense(), result.matched

    methods = {
        "reference": lambda: run_peer(peer, source, weights, target)[:2],
        "paper's method": lambda: ours(TransferConfig.paper()),
        "default": lambda: ours(TransferConfig()),
    }
    rows = {}
    for name, method in methods.items():
        seconds = []
        for _ in range(repeats):
            start = time.perf_counter()
            dense, matched = method()
            seconds.append(time.perf_counter() - start)
        lost = np.abs(dense.sum(axis=1) - 1.0) > 1e-6
        negative = float(dense.min())
        kept = SkinWeights.from_dense(np.where(lost[:, None], 1.0, dense)).dense()
        rows[name] = {
            "vertices": target.vertex_count,
            "unmatched": float(1 - np.mean(matched)),
            "seconds": min(seconds),
            "tv_mean": float(0.5 * np.abs(kept - authored).sum(axis=1).mean()),
            "tv_p95": float(np.percentile(0.5 * np.abs(kept - authored).sum(axis=1), 95)),
            "rows_not_summing_to_1": int(lost.sum()),
            "most_negative_weight": negative,
        }
    for row in rows.values():
        row["times_faster"] = rows["reference"]["seconds"] / row["seconds"]
    return rows


def main(options: Options) -> None:
    console, figures = Console(width=130), {}
    peer = load_peer(options.peer)
    for folder in find_captures(options.captures):
        rows = figures[folder.name] = compare_on(read_capture_truth(folder), peer, options.repeats)
        table = Table(title=folder.name)
        for column in ("method", *next(iter(rows.values()))):
            table.add_column(column)
        for name, row in rows.items():
            table.add_row(name, *(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()))
        console.print(table)
    store_results("transfer_speed", "python -m benchmarks.transfer_speed " + " ".join(sys.argv[1:]), figures)


if __name__ == "__main__":
    main(tyro.cli(Options))
