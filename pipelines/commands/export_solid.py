"""Body and clothes of a run as one closed surface for a printer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console

from pipelines.commands.templates import load_params_for, load_run_template
from smplxpp.clean import SolidConfig, solid_of_parts
from smplxpp.core import InputError, TriangleMesh, require_positive
from smplxpp.export.printing import check_solid_path, write_solid
from smplxpp.metrics import self_intersections
from smplxpp.metrics.distance import MM
from smplxpp.template.template import BODY_PART, Template

_GAP_MM = 10.0  # gap between body and cloth that is filled by default, mm of the person


@dataclass(frozen=True)
class SolidRequest:
    """Options of `smplxpp export --solid`, by their names."""

    params: Path | None
    frame: int
    height_mm: float | None
    thickness_mm: float
    gap_mm: float | None
    units: Literal["mm", "cm", "m"]


def export_solid(run: Path, solid: Path, request: SolidRequest) -> dict[str, Any]:
    """Make the solid, measure it, write it whole or not at all; return what it is.

    Raises:
        InputError: no finished template, another suffix, sizes that are not positive, parameters of another body.
    """
    check_solid_path(solid)
    # Check suffix and sizes before the template is posed and voxelised.
    for name in ("thickness_mm", "height_mm", "gap_mm"):
        if getattr(request, name) is not None:
            require_positive(f"option {name}", getattr(request, name))
    template = load_run_template(run)
    posed = _posed(template, request)
    # Scale the posed person to the wanted height. Only vertices of faces count: the template may hold unused ones.
    scale = 1.0
    if request.height_mm is not None:
        scale = request.height_mm / MM / float(np.ptp(posed.vertices[np.unique(posed.faces), 1]))
    posed = posed.with_vertices(posed.vertices * scale)
    parts = {name: posed.submesh(template.part_faces(name))[0] for name in template.part_names}
    # The default gap is in the person's size and shrinks with it; thickness is in the size of the print.
    gap = _GAP_MM * scale if request.gap_mm is None else request.gap_mm
    config = SolidConfig(thickness=request.thickness_mm / MM, gap=gap / MM)
    made = solid_of_parts(parts.pop(BODY_PART), parts, config=config)
    volume = write_solid(solid, made.mesh, units=request.units)
    return {
        "out": str(solid),
        "scale": scale,
        "thickness_mm": request.thickness_mm,
        **made.report.as_dict(),
        "file_volume_cm3": volume * 1e6,
        "self_intersections": len(self_intersections(made.mesh)),
    }


def _posed(template: Template, request: SolidRequest) -> TriangleMesh:
    if request.params is None:
        return template.mesh
    params = load_params_for(template, request.params)
    if not 0 <= request.frame < len(params):
        raise InputError("option frame", expected=f"an index below {len(params)}", received=str(request.frame))
    params = params.frame(request.frame)
    # Drop the translation: a printer's bed has no use for the person's position in the capture.
    still = replace(params, transl=np.zeros_like(params.transl))
    return template.mesh.with_vertices(template.pose(still)[0])


def print_solid(report: dict[str, Any], console: Console) -> None:
    """Print size, volume, wall thickness and self-intersections of a solid."""
    # Thickness is measured straight inward from places drawn by area; its low percentiles tell where a print breaks.
    size = " x ".join(f"{length:.0f}" for length in report["size_mm"])
    console.print(
        f"{report['out']}: one closed, manifold piece of {report['faces']} faces, {size} mm, "
        f"{report['volume_cm3']:.1f} cm3; read back, it is the same",
        markup=False,
        soft_wrap=True,
    )
    console.print(
        f"walls, straight inward: 1 % below {report['wall_mm_p1']:.2f} mm, 5 % below {report['wall_mm_p5']:.2f}, "
        f"median {report['wall_mm_median']:.2f}; {report['thin_share']:.1%} of the surface thinner than "
        f"{0.9 * report['thickness_mm']:.2g} mm",
        markup=False,
        soft_wrap=True,
    )
    if report["self_intersections"]:
        console.print(
            f"{report['self_intersections']} pairs of faces cut each other in folds narrower than the cloth: slicers "
            "join them, modellers may not",
            markup=False,
            soft_wrap=True,
        )
