"""Stage 00: a scan and parameters on disk become one clean scan in metres, +Y up, and one frame of parameters."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.runs.arrays import save_arrays
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildContext
from smplxpp.body import load_body, load_params
from smplxpp.clean import check_human_scale, convert_points, sanitize
from smplxpp.core.errors import InputError
from smplxpp.core.mesh_io import read_raw_mesh

GREY = 180


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write the scan in metres, +Y up, repaired, and the frame's parameters."""
    raw = read_raw_mesh(build.inputs.scan)
    vertices = convert_points(raw.vertices, units=build.config.units, up=build.config.up)
    try:
        clean = sanitize(vertices, raw.faces)
    except InputError as error:
        raise InputError(
            f"scan {build.inputs.scan.name}: {error.subject}",
            expected=error.expected,
            received=error.received,
            remedy=error.remedy,
        ) from None
    check_human_scale(clean.mesh.vertices, subject=f"scan {build.inputs.scan.name}")
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
    params = load_params(build.inputs.params, body=load_body(build.inputs.body))
    params.frame(build.inputs.params_row if len(params) > 1 else 0).save(folder / "params.npz")
    numbers = {"vertices": clean.mesh.vertex_count, "faces": clean.mesh.face_count, "repairs": str(clean.report)}
    return StageOutput(numbers=numbers)
