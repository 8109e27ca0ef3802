"""`smplxpp export RUN`: the student as a bundle for players (--out), or a closed surface for a printer (--solid)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console

from pipelines.commands.export_bundle import check_bundle_path, export_bundle
from pipelines.commands.options import OptionalFloat, OptionalPath, OptionalText
from pipelines.commands.templates import load_params_for, load_run_template
from smplxpp.clean import SolidConfig, solid_of_parts
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.validation import require_positive
from smplxpp.export.printing import check_solid_path, write_solid
from smplxpp.metrics import self_intersections
from smplxpp.metrics.distance import MM
from smplxpp.template.template import BODY_PART, Template

_GAP_MM = 10.0


@dataclass(frozen=True)
class Export:
    """Options of `smplxpp export`."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `smplxpp build` (and for --out `smplxpp train`) wrote."""
    out: OptionalPath = None
    """Write the trained student there for players: NAME.avatar, one file that needs neither torch nor this run."""
    solid: OptionalPath = None
    """Write body and clothes as one closed surface there: .stl or .3mf (z up, on the bed), .ply or .glb (y up)."""
    params: OptionalPath = None
    """Body parameters, any layout that `smplxpp params convert` reads: of the solid's pose, the T-pose without them; or
    the motion that the bundle has to play, the poses that training saw without them."""
    name: OptionalText = None
    """Name of the avatar in the bundle; by default that of the run's folder."""
    licence: str = ""
    """Licence of the avatar, as the bundle is to say it."""
    exact: bool = False
    """Keep every number of the bundle in float32, at about four times the size."""
    frame: int = 0
    """Row of the parameters."""
    height_mm: OptionalFloat = None
    """Height of the person in the file, in the pose; life-size without it."""
    thickness_mm: float = 2.0
    """Thickness of the cloth in the file's size, at every scale."""
    gap_mm: OptionalFloat = None
    """Cloth nearer to the body than this is filled down to it (in the file's size); without it 10 mm of the person."""
    units: Literal["mm", "cm", "m"] = "mm"
    """Units of the file; a GLB is always in metres."""
    json: bool = False
    """Print what was written as JSON."""

    def run(self) -> dict[str, Any]:
        """Write the bundle or the solid, whole or not at all."""
        if self.solid is not None and self.out is None:
            return self._solid(self.solid)
        if self.out is not None and self.solid is None:
            return self._bundle(self.out)
        raise InputError(
            "options out and solid",
            expected="one of them",
            received="none" if self.out is None else "both",
            remedy="`--out me.avatar` writes the student for players, `--solid me.stl` a body to print",
        )

    def _bundle(self, out: Path) -> dict[str, Any]:
        check_bundle_path(out)
        report = export_bundle(
            self.run_folder,
            out,
            name=self.name,
            licence=self.licence,
            params=self.params,
            exact=self.exact,
        )
        if not self.json:
            console = Console()
            console.print(f"{out}: {report['bytes']['total'] / 1e6:.2f} MB", markup=False, soft_wrap=True)
            for piece, size in report["bytes"].items():
                if piece != "total":
                    console.print(f"  {piece:10} {size / 1e3:9.1f} kB", markup=False)
        return report

    def _solid(self, solid: Path) -> dict[str, Any]:
        """Make the solid, measure it, write it."""
        check_solid_path(solid)
        for name in ("thickness_mm", "height_mm", "gap_mm"):
            if getattr(self, name) is not None:
                require_positive(f"option {name}", getattr(self, name))
        template = load_run_template(self.run_folder)
        posed = self._posed(template)
        scale = 1.0
        if self.height_mm is not None:
            scale = self.height_mm / MM / float(np.ptp(posed.vertices[np.unique(posed.faces), 1]))
        posed = posed.with_vertices(posed.vertices * scale)
        parts = {name: posed.submesh(template.part_faces(name))[0] for name in template.part_names}
        gap = _GAP_MM * scale if self.gap_mm is None else self.gap_mm
        config = SolidConfig(thickness=self.thickness_mm / MM, gap=gap / MM)
        made = solid_of_parts(parts.pop(BODY_PART), parts, config=config)
        volume = write_solid(solid, made.mesh, units=self.units)
        report = {
            "out": str(solid),
            "scale": scale,
            "thickness_mm": self.thickness_mm,
            **made.report.as_dict(),
            "file_volume_cm3": volume * 1e6,
            "self_intersections": len(self_intersections(made.mesh)),
        }
        if not self.json:
            _print(report, Console())
        return report

    def _posed(self, template: Template) -> TriangleMesh:
        if self.params is None:
            return template.mesh
        params = load_params_for(template, self.params)
        if not 0 <= self.frame < len(params):
            raise InputError("option frame", expected=f"an index below {len(params)}", received=str(self.frame))
        params = params.frame(self.frame)
        # Where the person stands and which way it looks is of no use on a printer's bed.
        still = replace(params, transl=np.zeros_like(params.transl))
        return template.mesh.with_vertices(template.pose(still)[0])


def _print(report: dict[str, Any], console: Console) -> None:
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
