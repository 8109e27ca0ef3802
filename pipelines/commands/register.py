"""`smplxpp register`: a capture (or a scan) in; body parameters of all its frames, residuals and a report out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipelines.commands.options import OptionalInt, OptionalPath, OptionalText
from pipelines.commands.terminal import print_checks, print_notes, print_paths
from smplxpp.core import InputError, require_at_least
from smplxpp.core.files.json_file import as_object, read_json

if TYPE_CHECKING:
    from pipelines.runs.stage import StageRecord
    from pipelines.stages.build_config import RegisterInputs


@dataclass(frozen=True)
class Register:
    """Options of `smplxpp register`. Give --capture, or --scan with --params or --landmarks."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of the run; the registration goes into it as 05_register, and `smplxpp build` there takes it up."""
    capture: OptionalPath = None
    """Folder of a capture in any layout of docs/captures.md: cameras with keypoints, masks, label maps; scans."""
    scan: OptionalPath = None
    """Scan of the frame --frame, in the place of the capture's, or alone with --params."""
    scans: OptionalPath = None
    """Folder of scans, scan_FFFFFF.ply a frame, in the place of the capture's own: what `smplxpp reconstruct --frame
    all` wrote."""
    params: OptionalPath = None
    """Body parameters to start from, in the place of the capture's own."""
    shape: OptionalPath = None
    """Body parameters whose shape all frames get; by default it is fitted to them. Chunks of a long take share one."""
    keypoints: OptionalPath = None
    """Folder of keypoints, of `smplxpp keypoints detect` or any other detector, in the place of the capture's own."""
    subject: OptionalInt = None
    """Person to register where several are in view, by the number that a note gives; by default the first: whom most
    views agree on, large in the pictures and near the middle."""
    masks: OptionalPath = None
    """Folder of masks, in the place of the capture's own."""
    initial: Literal["params", "none"] = "params"
    """params: start from the parameters. none: ignore them, and start from keypoints alone."""
    protocol: OptionalText = None
    """Protocol of the capture, which names the files that are read."""
    frames: OptionalText = None
    """Frames to register: numbers and ranges START:STOP:STEP with commas; by default all that the split names."""
    frame: int = 0
    """Reference frame: the one of --scan and --labels."""
    labels: OptionalPath = None
    """Labels of the reference frame's scan; without them its label maps vote."""
    label_set: str = "capture"
    """Label set of --labels, or a JSON file that maps ids to names."""
    landmarks: OptionalPath = None
    """Landmarks of that scan, a JSON object of points by name; kept in the run as landmarks.json, which is read
    whenever it lies there."""
    hold_out: tuple[str, ...] = ()
    """Cameras to leave out; by default those that the capture holds out."""
    body: OptionalPath = None
    """SMPL-X-layout body file; the open body by default."""
    units: Literal["m", "cm", "mm", "inch"] = "m"
    """Units of scan files."""
    up: Literal["y", "z", "x", "-y", "-z", "-x"] = "y"
    """Upward axis of scan files."""
    seed: int = 0
    """Seed of the sampled points."""
    force: bool = False
    """Register again even if the registration is up to date."""
    no_report: bool = False
    """Leave out the page register.html, or the section of a run's report."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Register, write the report, print residuals before and after."""
        from pipelines.commands.terminal import shared_progress
        from pipelines.runs.artefacts import values_of
        from pipelines.runs.folders import keep_out_of_capture, own_run_folder, take_file
        from pipelines.runs.layout import LANDMARKS_FILE, REGISTER_STAGE
        from pipelines.stages.register_capture import register_capture
        from smplxpp.register import read_landmarks

        keep_out_of_capture(self.run_folder, self.capture, subject="RUN")
        require_at_least("option seed", self.seed, 0)
        require_at_least("option frame", self.frame, 0)
        inputs = self.inputs()
        # Landmarks are copied into the run and stay there; the registration reads them from it.
        take_file(self.run_folder, LANDMARKS_FILE, self.landmarks, read=read_landmarks)
        with (
            own_run_folder(self.run_folder, (REGISTER_STAGE, "register")),
            shared_progress(enabled=not self.json) as progress,
        ):
            record = register_capture(self.run_folder, inputs, force=self.force, progress=progress)
            report = None if self.no_report else self._report(record)
        # The details lie in the stage's file, because the manifest holds summary figures only.
        path = record.folder / "registration.json"
        content = as_object(read_json(path, subject="registration"), subject=f"registration {path}")
        with values_of(path):
            details = {"by_camera": content["by_camera"], "notes": content["problems"]}
            if not self.json:
                _print(record, content, report)
        return {
            **record.manifest["numbers"],
            "run": str(self.run_folder),
            "ran": record.ran,
            "params": str(record.folder / "params.npz"),
            **details,
            "checks": record.manifest["checks"],
            "report": None if report is None else str(report),
        }

    def inputs(self) -> RegisterInputs:
        """Check the options and return the inputs of the registration.

        Raises:
            InputError: neither a capture nor a scan, a missing file, frames that the capture has not.
        """
        from pipelines.commands.options import selected_frames
        from smplxpp.build.config import RegisterInputs
        from smplxpp.build.request import named_params
        from smplxpp.capture import open_capture

        # Check that options fit together before files are read.
        if self.capture is None and self.scan is None:
            raise InputError("input", expected="--capture, or --scan with --params", received="neither")
        for name in ("scan", "labels", "landmarks", "body", "shape"):
            path = getattr(self, name)
            if path is not None and not path.exists():
                raise InputError(f"option {name}", expected="an existing file", received=str(path))
        for name in ("keypoints", "masks", "subject", "shape"):
            if getattr(self, name) is not None and self.capture is None:
                raise InputError(f"option {name}", expected="a --capture whose cameras they are of", received="none")
        if self.scans is not None and (self.capture is None or self.scan is not None):
            received = "none" if self.capture is None else "--scan beside it"
            raise InputError("option scans", expected="a --capture whose frames they are of", received=received)
        if self.initial == "none" and self.params is not None:
            raise InputError("option initial", expected="none without --params", received="both")
        if self.frames is not None and self.capture is None:
            raise InputError("--frames", expected="a --capture that has them", received="a scan alone: see --frame")
        # Only a capture knows which frame numbers exist.
        frames = None
        if self.frames is not None and self.capture is not None:
            frames = selected_frames(self.frames, open_capture(self.capture, protocol=self.protocol))
        return RegisterInputs(
            capture=self.capture,
            params=named_params(self.capture, self.params),
            start=self.initial == "params",
            protocol=self.protocol,
            frames=frames,
            hold_out=self.hold_out,
            body=self.body,
            scan=self.scan,
            frame=self.frame,
            labels=self.labels,
            label_set=self.label_set,
            units=self.units,
            up=self.up,
            seed=self.seed,
            keypoints=self.keypoints,
            masks=self.masks,
            scans=self.scans,
            subject=self.subject,
            shape=self.shape,
        )

    def _report(self, record: StageRecord) -> Path:
        """Write the registration's own page, unless it is newer than the registration."""
        from pipelines.report.sections.register import write_register_report

        page = self.run_folder / "register.html"
        # Compare modification times in nanoseconds: a page older than its stage shows old figures.
        made = (record.folder / "manifest.json").stat().st_mtime_ns
        if record.ran or not page.is_file() or page.stat().st_mtime_ns < made:
            write_register_report(page, self.run_folder, record)
        return page


def _print(record: StageRecord, content: Mapping[str, Any], report: Path | None) -> None:
    """Print residuals, checks that did not pass, the first notes, and the files."""
    from smplxpp.build.register import RESIDUALS

    console, numbers = Console(), record.manifest["numbers"]
    medians = numbers["residuals"]
    # Residuals before and after, as medians over frames.
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column("median over frames")
    for when in ("before", "after"):
        table.add_column(when, justify="right")
    for name, after in medians["after"].items():
        shown = RESIDUALS.get(name)
        title, unit = (name, "") if shown is None else (shown.words, shown.unit)
        before = medians["before"].get(name)
        table.add_row(title, "-" if before is None else f"{before:.2f} {unit}", f"{after:.2f} {unit}")
    console.print(table)
    # A camera whose residual stays high has a wrong calibration or wrong keypoints.
    for name, found in content["by_camera"].items():
        before = f"{found['before']['median_px']:.2f} to " if "before" in found else ""
        after = f"{found['after']['median_px']:.2f}" if "after" in found else "-"
        console.print(
            f"[dim]{escape(name)}[/]  {found['points']} keypoints, median {before}{after} px", highlight=False
        )
    print_checks(record.manifest["checks"], console)
    print_notes(content["problems"], console)
    absent = f", {len(content['absent'])} could not be" if content["absent"] else ""
    how = "" if record.ran else "; stands, not run again"
    console.print(f"{numbers['frames']} frames registered{absent}{how}", highlight=False)
    print_paths({"params": record.folder / "params.npz", "report": report}, console)
