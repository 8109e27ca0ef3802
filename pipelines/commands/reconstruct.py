"""`smplxpp reconstruct`: photographs, cameras and masks in; the person's surface, and where it is sure, out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console
from rich.markup import escape

from pipelines.commands.options import OptionalFloat, OptionalPath, OptionalText, require_avatar
from pipelines.report.model import CheckRow
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_object, read_json
from smplxpp.core.validation import require_at_least, require_positive

if TYPE_CHECKING:
    from pipelines.runs.stage import StageRecord
    from pipelines.stages.build_config import ReconstructInputs
    from pipelines.stages.reconstruct import Method

_SHOWN = 8


@dataclass(frozen=True)
class ReconstructCommand:
    """Options of `smplxpp reconstruct`."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of the run; surfaces go into it as 02_reconstruct/scan_FFFFFF.ply, which a build takes as its scan."""
    capture: Path
    """Folder of a capture in any layout of docs/captures.md: photographs, cameras and masks."""
    frame: str = "0"
    """Frame to reconstruct; all: every training frame; or numbers and ranges START:STOP:STEP with commas."""
    hold_out: tuple[str, ...] = ()
    """Cameras that are not looked at; by default those that the capture holds out."""
    masks: OptionalPath = None
    """Folder of masks, in the place of the capture's own."""
    protocol: OptionalText = None
    """Protocol of the capture, which names the files that are read."""
    cell: OptionalFloat = None
    """Size of the grid's cells in mm; by default two pixels, within 3 to 6 mm."""
    dissent: int = 0
    """Views that may say of a point that it is outside: the surface grows by a centimetre with each, which is more than
    holes in masks cost."""
    hull_only: bool = False
    """Take the silhouettes' surface and do not compare the photographs."""
    mesh: OptionalPath = None
    """Mesh of the frame by NeuS2, Instant-NGP or another program, which is taken in the place of ours; the masks tell
    whether it lies in the cameras' world or in the trainer's unit cube."""
    method: Literal["sweep", "sdf"] = "sweep"
    """sweep: photographs compared along the normals. sdf: a neural signed distance over the hull, which needs the extra
    avatar and a CUDA device."""
    device: Literal["cuda", "cpu"] = "cuda"
    """Device of --method sdf; cpu takes hours."""
    iterations: int = 15_000
    """Of --method sdf."""
    force: bool = False
    """Reconstruct anew even if the stage stands."""
    no_report: bool = False
    """Leave out the page reconstruct.html."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Reconstruct, write the report, print what is sure and what is not."""
        from pipelines.commands.progress import shared_progress
        from pipelines.runs.folders import keep_out_of_capture, own_run_folder
        from pipelines.runs.layout import RECONSTRUCT_STAGE
        from pipelines.stages.reconstruct import reconstruct_capture

        keep_out_of_capture(self.run_folder, self.capture, subject="RUN")
        inputs, method = self.inputs(), self._method()
        own = own_run_folder(self.run_folder, (RECONSTRUCT_STAGE, "reconstruct"))
        with own, shared_progress(enabled=not self.json) as progress:
            record = reconstruct_capture(self.run_folder, inputs, method=method, force=self.force, progress=progress)
            report = None if self.no_report else self._report(record)
        path = record.folder / "reconstruction.json"
        content = as_object(read_json(path, subject="reconstruction"), subject=f"reconstruction {path}")
        frames = as_object(content["frames"], subject=f"reconstruction {path}: frames")
        scans = {frame: str(record.folder / f"scan_{int(frame):06d}.ply") for frame in frames}
        problems = [f"frame {frame}: {words}" for frame, one in frames.items() for words in one["problems"]]
        problems += [f"frame {frame} left out: {words}" for frame, words in content["absent"].items()]
        if not self.json:
            _print(record, scans, problems, report)
        return {
            **record.manifest["numbers"],
            "run": str(self.run_folder),
            "ran": record.ran,
            "scans": scans,
            "problems": problems,
            "checks": record.manifest["checks"],
            "report": None if report is None else str(report),
        }

    def inputs(self) -> ReconstructInputs:
        """What is reconstructed.

        Raises:
            InputError: options that make no sense, a missing folder, frames that the capture has not.
        """
        from pipelines.commands.capture import selected_frames
        from pipelines.stages.build_config import ReconstructInputs
        from smplxpp.capture import open_capture

        require_at_least("option dissent", self.dissent, 0)
        if self.cell is not None:
            require_positive("option cell", self.cell)
        if self.masks is not None and not self.masks.is_dir():
            raise InputError("option masks", expected="an existing folder", received=str(self.masks))
        if self.mesh is not None and not self.mesh.is_file():
            raise InputError("option mesh", expected="an existing file", received=str(self.mesh))
        frames = None
        if self.frame.strip() != "all":
            frames = selected_frames(self.frame, open_capture(self.capture, protocol=self.protocol))
        return ReconstructInputs(
            capture=self.capture,
            frames=frames,
            hold_out=self.hold_out,
            masks=self.masks,
            protocol=self.protocol,
            refine=not self.hull_only,
            cell_mm=self.cell,
            dissent=self.dissent,
            mesh=self.mesh,
        )

    def _method(self) -> Method | None:
        """What makes the surfaces of --method sdf.

        Raises:
            MissingExtraError: the extra avatar is not installed.
            InputError: no CUDA device, options that exclude each other.
        """
        if self.method != "sdf":
            return None
        require_avatar("--method sdf")
        if self.mesh is not None or self.hull_only:
            raise InputError("--method sdf", expected="neither --mesh nor --hull-only with it", received="one of them")
        from avatar.reconstruct import SurfaceConfig
        from pipelines.stages.neural_surface import neural_method
        from smplxpp.reconstruct import ReconstructConfig

        config = ReconstructConfig(cell=None if self.cell is None else 1e-3 * self.cell, dissent=self.dissent)
        return neural_method(config, SurfaceConfig(iterations=self.iterations), self.device)

    def _report(self, record: StageRecord) -> Path:
        """Write the reconstruction's own page, unless it is newer than the reconstruction."""
        from pipelines.report.sections.reconstruct import write_reconstruct_report

        page = self.run_folder / "reconstruct.html"
        made = (record.folder / "manifest.json").stat().st_mtime_ns
        if record.ran or not page.is_file() or page.stat().st_mtime_ns < made:
            write_reconstruct_report(page, self.run_folder, record)
        return page


def _print(record: StageRecord, scans: dict[str, str], problems: list[str], report: Path | None) -> None:
    console, numbers = Console(), record.manifest["numbers"]
    console.print(
        f"{numbers['frames']} frames, {len(numbers['seen']['cameras'])} cameras of {numbers['pixel_mm']:.1f} mm a "
        f"pixel, cells of {numbers['cell_mm']:.1f} mm: {numbers['vertices']:,} vertices; photographs moved the hull by "
        f"{numbers['moved_mm']:.1f} mm",
        highlight=False,
        soft_wrap=True,
    )
    console.print(
        f"{100 * numbers['unseen']:.0f} % of the surface is seen by fewer than two cameras, "
        f"{100 * numbers['unsure']:.0f} % has no photograph that speaks for it",
        highlight=False,
        soft_wrap=True,
    )
    for check in map(CheckRow.of, record.manifest["checks"]):
        if check.status != "pass":
            style = "red" if check.status == "fail" else "yellow"
            words = escape(f"{check.name}: {check.shown}, {check.explanation}")
            console.print(f"[{style}]{check.status}[/]  {words}", soft_wrap=True)
    for words in problems[:_SHOWN]:
        console.print(f"[yellow]problem[/]  {escape(words)}", soft_wrap=True, highlight=False)
    if len(problems) > _SHOWN:
        console.print(f"[dim]and {len(problems) - _SHOWN} more (--json lists all)[/]")
    if not record.ran:
        console.print("stands, not run again")
    first = next(iter(scans.values()))
    for name, path in (("scan", first), ("report", report)):
        if path is not None:
            console.print(f"{name}  {path}", soft_wrap=True, highlight=False, markup=False)
