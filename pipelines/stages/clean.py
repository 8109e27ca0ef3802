"""Stage 30: one clean mesh within its face budget for every part that is not skin."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.runs.artefacts import (
    load_scan,
    load_scan_labels,
    save_arrays,
)
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildContext
from smplxpp.clean import PartsConfig, clean_parts
from smplxpp.core.checks import Check
from smplxpp.metrics import mesh_quality, point_to_surface
from smplxpp.metrics.distance import MM


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write one clean mesh within its face budget for every part that is not skin."""
    scan, colors, _ = load_scan(build.run)
    face_labels = load_scan_labels(build.run, scan.face_count)
    config = PartsConfig(face_budgets=build.config.budgets, method=build.config.remesh)
    parts = clean_parts(scan, face_labels, config=config, vertex_colors=colors)
    save_arrays(
        folder / "parts.npz",
        {
            name: {
                "vertices": part.mesh.vertices,
                "faces": part.mesh.faces,
                "label": np.array(part.label),
                "source_vertex": part.source_vertex,
                "colors": np.asarray(part.vertex_colors),
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
