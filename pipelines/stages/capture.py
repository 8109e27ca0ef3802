"""Stage 00: a scan and parameters on disk become one clean scan in metres, +Y up, and one frame of parameters."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.runs.artefacts import load_stacked_params, save_arrays
from pipelines.runs.gates import ROUGHNESS
from pipelines.runs.layout import LOCATED_PARAMS, REGISTERED_PARAMS
from pipelines.runs.stage import StageOutput
from pipelines.stages.build_config import BuildContext
from pipelines.stages.scan_files import read_scan
from smplxpp.body import load_body, load_params
from smplxpp.clean import smooth_if_rough
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams
from smplxpp.metrics.distance import MM

GREY = 180


def run(folder: Path, build: BuildContext) -> StageOutput:
    """Write the scan in metres, +Y up, repaired, and the frame's parameters."""
    scan = read_scan(build.inputs.scan, units=build.config.units, up=build.config.up)
    clean = scan.clean
    smoothed = smooth_if_rough(clean.mesh)
    colors = np.full((clean.mesh.vertex_count, 3), GREY, np.uint8) if scan.colors is None else scan.colors
    save_arrays(
        folder / "scan.npz",
        {
            "scan": {
                "vertices": smoothed.mesh.vertices,
                "faces": clean.mesh.faces,
                "colors": colors,
                "source_vertex": clean.source_vertex,
                "source_face": clean.source_face,
            }
        },
    )
    _params_of_frame(build).save(folder / "params.npz")
    numbers = {"vertices": clean.mesh.vertex_count, "faces": clean.mesh.face_count, "repairs": str(clean.report)}
    numbers |= {"units": scan.units, "up": scan.up, "said": scan.said}
    numbers |= {"smoothing_steps": smoothed.steps, "smoothing_moved_mm": smoothed.moved * MM}
    explanation = "how far vertices stand off their neighbours, as a share of the median edge"
    if smoothed.steps:
        explanation += f"; smoothed: vertices moved by {smoothed.moved * MM:.1f} mm, what follows is of that surface"
    return StageOutput([ROUGHNESS.check("roughness of the scan", smoothed.roughness, explanation=explanation)], numbers)


def _params_of_frame(build: BuildContext) -> BodyParams:
    """The reference frame's parameters: given ones, those of the run's registration, or of the body that was found.

    Raises:
        InputError: the frame could not be registered.
    """
    inputs = build.inputs
    if inputs.params is not None:
        params = load_params(inputs.params, body=load_body(inputs.body))
        return params.frame(inputs.params_row if len(params) > 1 else 0)
    if not inputs.registers:
        return load_params(build.run / LOCATED_PARAMS)
    frames, fitted = load_stacked_params(build.run / REGISTERED_PARAMS)
    if inputs.frame not in frames:
        raise InputError(
            f"reference frame {inputs.frame}",
            expected="a frame that was registered",
            received=f"none of the {len(frames)} that were, {frames[0]} to {frames[-1]}",
            remedy="choose another with --frame, or give its parameters with --params and --register off",
        )
    return fitted.frame(frames.index(inputs.frame))
