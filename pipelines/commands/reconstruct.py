"""`smplxpp reconstruct`: photographs, cameras and masks in; the person's surface and its confidence out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from pipelines.commands.options import OptionalFloat, OptionalPath, OptionalText, require_avatar
from pipelines.commands.terminal import print_checks, print_notes, print_paths
from smplxpp.core import InputError, require_at_least, require_positive
from smplxpp.core.files.json_file import as_object, read_json

if TYPE_CHECKING:
    from pipelines.runs.stage import StageRecord
    from pipelines.stages.build_config import ReconstructInputs
    from pipelines.stages.reconstruct import Method


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
    """Cameras to leave out; by default those that the capture holds out."""
    masks: OptionalPath = None
    """Folder of masks, in the place of the capture's own."""
    protocol: OptionalText = None
    """Protocol of the capture, which names the files that are read."""
    cell: OptionalFloat = None
    """Size of the grid's cells in mm; by default two pixels, within 3 to 6 mm."""
    dissent: int = 0
    """Number of views whose masks may exclude a point that the hull keeps. Each one lets the surface grow by about a
    centimetre, which is more than holes in masks cost."""
    hull_only: bool = False
    """Stop at the visual hull of the silhouettes, without refinement on the photographs."""
    mesh: OptionalPath = None
    """Mesh of the frame by NeuS2, Instant-NGP or another program, used in the place of ours. The masks decide whether
    its coordinates are the cameras' world or the trainer's unit cube."""
    method: Literal["sweep", "sdf"] = "sweep"
    """sweep: photographs compared along the normals. sdf: a neural signed distance over the hull, which needs the extra
    avatar and a CUDA device."""
    device: Literal["cuda", "cpu"] = "cuda"
    """Device of --method sdf; cpu takes hours."""
    iterations: int = 15_000
    """Iterations of --method sdf."""
    force: bool = False
    """Reconstruct again even if the stage is up to date."""
    no_report: bool = False
    """Leave out the page reconstruct.html."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Reconstruct the frames, write the report, print the surface's confidence and the notes."""
        from pipelines.commands.terminal import shared_progress
        from pipelines.runs.folders import keep_out_of_capture, own_run_folder
        from pipelines.runs.layout import RECONSTRUCT_STAGE
        from pipelines.stages.reconstruct import reconstruct_capture

        keep_out_of_capture(self.run_folder, self.capture, subject="RUN")
        inputs, method = self.inputs(), self._method()
        # Hold the run's lock during work and report.
        own = own_run_folder(self.run_folder, (RECONSTRUCT_STAGE, "reconstruct"))
        with own, shared_progress(enabled=not self.json) as progress:
            record = reconstruct_capture(self.run_folder, inputs, method=method, force=self.force, progress=progress)
            report = None if self.no_report else self._report(record)
        path = record.folder / "reconstruction.json"
        content = as_object(read_json(path, subject="reconstruction"), subject=f"reconstruction {path}")
        frames = as_object(content["frames"], subject=f"reconstruction {path}: frames")
        scans = {frame: str(record.folder / f"scan_{int(frame):06d}.ply") for frame in frames}
        # Notes of every frame, and the reasons of frames that could not be reconstructed.
        notes = [f"frame {frame}: {note}" for frame, one in frames.items() for note in one["problems"]]
        notes += [f"frame {frame} left out: {reason}" for frame, reason in content["absent"].items()]
        if not self.json:
            _print(record, scans, notes, report)
        return {
            **record.manifest["numbers"],
            "run": str(self.run_folder),
            "ran": record.ran,
            "scans": scans,
            "notes": notes,
            "checks": record.manifest["checks"],
            "report": None if report is None else str(report),
        }

    def inputs(self) -> ReconstructInputs:
        """Check the options and return the inputs of the reconstruction.

        Raises:
            InputError: a number out of range, a missing file or folder, frames that the capture does not have.
        """
        from pipelines.commands.options import selected_frames
        from pipelines.stages.build_config import ReconstructInputs
        from smplxpp.capture import open_capture

        # Check ranges and files first: a reconstruction takes minutes for each frame.
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
        """Return the neural method for --method sdf, None for the plane sweep.

        Raises:
            MissingExtraError: the extra avatar is not installed.
            InputError: no CUDA device, options that exclude each other.
        """
        if self.method != "sdf":
            return None
        require_avatar("--method sdf")
        # The neural method makes its own surface within the hull, so that neither option applies.
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
        # Compare modification times in nanoseconds: a page older than its stage shows old figures.
        made = (record.folder / "manifest.json").stat().st_mtime_ns
        if record.ran or not page.is_file() or page.stat().st_mtime_ns < made:
            write_reconstruct_report(page, self.run_folder, record)
        return page


def _print(record: StageRecord, scans: dict[str, str], notes: list[str], report: Path | None) -> None:
    """Print size and accuracy of the surfaces, checks that did not pass, the first notes, and the files."""
    console, numbers = Console(), record.manifest["numbers"]
    # Size and resolution first, then the share of the surface that can be trusted.
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
    print_checks(record.manifest["checks"], console)
    print_notes(notes, console)
    if not record.ran:
        console.print("stands, not run again")
    print_paths({"scan": next(iter(scans.values())), "report": report}, console)
