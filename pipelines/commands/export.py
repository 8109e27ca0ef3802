"""`smplxpp export`: a student or a template in files for players, other programs (--out) and printers (--solid)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console

from pipelines.commands.export_request import FileRequest, export_file, format_of
from pipelines.commands.options import ClothMode, OptionalFloat, OptionalInt, OptionalPath, OptionalText
from pipelines.commands.templates import export_bundle, load_params_for, load_run_template
from smplxpp.clean import SolidConfig, solid_of_parts
from smplxpp.core import InputError, TriangleMesh, require_positive
from smplxpp.core.files.json_file import as_object, read_json
from smplxpp.export.by_suffix import ExportOptions
from smplxpp.export.printing import check_solid_path, write_solid
from smplxpp.metrics import self_intersections
from smplxpp.metrics.comparison import MM
from smplxpp.template.template import BODY_PART, Template


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
    # Gap between body and cloth that is filled by default, mm of the person.
    gap_mm = 10.0
    # The default gap is in the person's size and shrinks with it; thickness is in the size of the print.
    gap = gap_mm * scale if request.gap_mm is None else request.gap_mm
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


@dataclass(frozen=True)
class Export:
    """Options of `smplxpp export`."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `smplxpp build` and `smplxpp train` wrote, or a bundle NAME.avatar of its student."""
    out: OptionalPath = None
    """Write a file there; its suffix says which: .avatar (the student for our players), .ply .spz .sog (its splats in a
    pose), .glb and .usdc (see --model), .fbx, .vrm and .obj (the template), .onnx (pose to splats), .bvh and
    .npz (a motion). A name without a suffix: a folder, a file a frame, with --format."""
    format: Literal[
        "auto", "avatar", "ply", "spz", "sog", "glb", "usd", "fbx", "vrm", "obj", "onnx", "bvh", "amass", "webavatar"
    ] = "auto"
    """Format where the suffix does not tell: of a folder, or of an .npz."""
    model: Literal["auto", "student", "template"] = "auto"
    """What a GLB or USD has: the student's splats in a pose, or the template with skeleton, expressions and motion.
    auto: the student where the source has one, else the template."""
    solid: OptionalPath = None
    """Write body and clothes as one closed surface there: .stl or .3mf (z up, on the bed), .ply or .glb (y up)."""
    params: OptionalPath = None
    """Body parameters, any layout that `smplxpp params convert` reads: the pose, or the motion. Without them: the poses
    that training saw (the template and a solid: the T-pose)."""
    frame: int = 0
    """Row of the parameters; of what moves the first one."""
    stop: OptionalInt = None
    """Of what moves: the row after the last one."""
    step: int = 1
    """Of what moves: take every step-th row."""
    fps: OptionalFloat = None
    """Frames a second of --params, for a file that states none or a wrong rate (default: as it says)."""
    cloth: ClothMode = "simulate"
    """What moves loose clothes in splats and OBJ files of --params: a simulation, the joints alone, or (splats) the
    student's own field."""
    full_harmonics: bool = False
    """Fill a PLY up with zeros to harmonics of degree 3: some importers (Unity's) take no others."""
    up: Literal["y", "-y", "z"] = "y"
    """The axis that points up in a PLY, whose users disagree; other formats say it themselves."""
    joint_names: Literal["smplx", "mixamo", "unity", "unreal", "vrm"] = "smplx"
    """Whose names the joints of a rigged template or a BVH have; joints without a name there keep ours."""
    max_influences: OptionalInt = None
    """Most joints that move a vertex of a rigged template, such as the 4 or 8 of an engine; the largest weights stay.
    By default as many as the format holds, 8 in a GLB."""
    texture_size: Annotated[Literal[0, 1024, 2048, 4096] | None, tyro.conf.arg(metavar="TEXELS")] = None
    """Texels a side of a template's texture, at most what the build made; 0: colours of vertices."""
    texture_source: Literal["build", "student"] = "build"
    """What paints a template's texture: the build, from scan or photographs, or the trained student."""
    faces: tuple[int, ...] = ()
    """Faces of a coarser template, such as 10000; several numbers make a file each: NAME_LOD0, NAME_LOD1 and so on."""
    blender: OptionalPath = None
    """Blender, or a Python with bpy, which writes FBX; by default $BLENDER, `blender` on the path, or bpy."""
    name: OptionalText = None
    """Name of the avatar in the bundle or VRM; by default that of the run's folder, or of the file."""
    licence: str = ""
    """Licence of the avatar, as the bundle is to say it; of a VRM its address, https://..."""
    authors: tuple[str, ...] = ()
    """Who made the avatar, as a VRM is to say it."""
    meta: OptionalPath = None
    """JSON file with more fields of VRM's `meta`, such as {"commercialUsage": "corporation"}; where it is silent the
    file permits next to nothing."""
    exact: bool = False
    """Keep every number of the bundle in float32, at about four times the size."""
    height_mm: OptionalFloat = None
    """Height of the person in the solid, in the pose; life-size without it."""
    thickness_mm: float = 2.0
    """Thickness of the solid's cloth in the file's size, at every scale."""
    gap_mm: OptionalFloat = None
    """Cloth nearer to the body than this is filled down to it (in the file's size); without it 10 mm of the person."""
    units: Literal["mm", "cm", "m"] = "mm"
    """Units of the solid; a GLB is always in metres."""
    json: bool = False
    """Print what was written as JSON."""

    def run(self) -> dict[str, Any]:
        """Write what was asked for, whole or not at all."""
        if self.solid is not None and self.out is None:
            return self._solid(self.solid)
        if self.out is not None and self.solid is None:
            name = format_of(self.out, self.format)
            return self._bundle(self.out) if name == "avatar" else self._file(self.out, name)
        raise InputError(
            "options out and solid",
            expected="one of them",
            received="none" if self.out is None else "both",
            remedy="`--out me.avatar` writes the student for players, `--solid me.stl` a body to print",
        )

    def _bundle(self, out: Path) -> dict[str, Any]:
        report = export_bundle(
            self.run_folder,
            out,
            name=self.name,
            licence=self.licence,
            params=self.params,
            exact=self.exact,
            fps=self.fps,
        )
        if not self.json:
            console = Console()
            console.print(f"{out}: {report['bytes']['total'] / 1e6:.2f} MB", markup=False, soft_wrap=True)
            for piece, size in report["bytes"].items():
                if piece != "total":
                    console.print(f"  {piece:10} {size / 1e3:9.1f} kB", markup=False)
        return report

    def _file(self, out: Path, name: str) -> dict[str, Any]:
        if name != "vrm" and (self.authors or self.meta is not None):
            raise InputError("options authors and meta", expected="a .vrm, whose terms they are", received=out.name)
        request = FileRequest(
            source=self.run_folder,
            out=out,
            format=name,
            model=self.model,
            params=self.params,
            rows=(self.frame, self.stop, self.step),
            fps=self.fps,
            cloth=self.cloth,
            full_harmonics=self.full_harmonics,
            up=self.up,
            quiet=self.json,
            rigged=ExportOptions(
                joint_names=self.joint_names,
                max_influences=self.max_influences,
                texture_size=self.texture_size,
                blender=self.blender,
                meta=self._meta() if name == "vrm" else None,
            ),
            faces=self.faces,
            texture_source=self.texture_source,
        )
        # The notes go to standard error, so that a script that reads the output sees the file alone.
        report = export_file(request)
        if not self.json:
            frames = f", {report['frames']} frames" if report["frames"] > 1 else ""
            Console().print(f"{report['out']}: {report['bytes'] / 1e6:.2f} MB{frames}", markup=False, soft_wrap=True)
            for sentence in report["notes"]:
                Console(stderr=True).print(sentence, markup=False, soft_wrap=True)
        return report

    def _meta(self) -> dict[str, Any] | None:
        """Return what the options state for a VRM; None where they state nothing."""
        stated = (
            {} if self.meta is None else dict(as_object(read_json(self.meta, subject="VRM meta"), subject="VRM meta"))
        )
        stated |= {} if self.name is None else {"name": self.name}
        stated |= {"authors": list(self.authors)} if self.authors else {}
        stated |= {"licenseUrl": self.licence} if self.licence else {}
        return stated or None

    def _solid(self, solid: Path) -> dict[str, Any]:
        report = export_solid(
            self.run_folder,
            solid,
            SolidRequest(self.params, self.frame, self.height_mm, self.thickness_mm, self.gap_mm, self.units),
        )
        if not self.json:
            print_solid(report, Console())
        return report
