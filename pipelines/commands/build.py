"""`smplxpp build`: a scan, a body fit and labels in; a template, its numbers and a report out."""

from __future__ import annotations

import dataclasses
import logging
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pipelines.commands.options import OptionalPath, OptionalText
from pipelines.commands.progress import stage_progress
from pipelines.runs.by_hand import take_file
from pipelines.runs.layout import (
    BIND_STAGE,
    BUILD_STAGES,
    CORRECTIONS_FILE,
    EVALUATE_STAGE,
    LANDMARKS_FILE,
    REFINE_STAGE,
    REGISTER_STAGE,
    TRAIN_STAGES,
    reconstructed_scan,
)
from pipelines.runs.places import keep_out_of_capture, same_place
from pipelines.runs.stage import StageRecord, read_manifest
from pipelines.stages.build_config import MOST_PHOTOGRAPHS, BuildConfig, BuildInputs
from pipelines.stages.reconstruct_config import ReconstructInputs, load_reconstruct
from pipelines.stages.register_config import RegisterInputs, load_register, named_params
from pipelines.stages.said_of_inputs import TRACKED, SaidOfInputs
from smplxpp.capture import ReferenceFrame, find_reference
from smplxpp.capture.protocols import choose_protocol, read_description
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import read_json
from smplxpp.core.spread import spread

log = logging.getLogger(__name__)
StageName = Literal[BUILD_STAGES]  # type: ignore[valid-type]


@dataclass(frozen=True)
class Build:
    """Options of `smplxpp build`. Give --capture, or --scan: alone, or with what is known of it (--params, --labels)."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the run; stages that stand in it are not run again."""
    capture: OptionalPath = None
    """Folder of a capture: photographs, cameras and masks; scans/scan_FFFFFF.ply, params/, labels as far as there are
    any. A scan that there is not is reconstructed, and the body is found."""
    scan: OptionalPath = None
    """Clothed scan of the reference frame (PLY, OBJ, GLB, STL, OFF, npz)."""
    params: OptionalPath = None
    """Body parameters of that frame, any layout that `smplxpp params convert` reads. Without them the body is found in
    the scan."""
    labels: OptionalPath = None
    """Labels of the scan's vertices or faces: npz, npy, 4D-Dress pickle, or a coloured mesh. Where neither they, nor the
    scan, nor label maps of its views say what is what, the body in the scan and its colours do."""
    keypoints: OptionalPath = None
    """With --capture: folder of keypoints, of `smplxpp keypoints detect` or any other detector, in the place of its own."""
    masks: OptionalPath = None
    """With --capture: folder of masks, in the place of its own."""
    landmarks: OptionalPath = None
    """Landmarks of the scan, a JSON object of points by name: they tell where the body is that is not given. Kept in the
    run as landmarks.json, which is read whenever it lies there."""
    corrections: OptionalPath = None
    """Labels corrected by hand, as `smplxpp label` writes them. Kept in the run as labels_corrections.json, which is
    read whenever it lies there."""
    label_set: str = "auto"
    """Label set of the labels: 4ddress, capture, lip, cihp, atr, sapiens, or a JSON file that maps ids to names.
    auto: `capture` with --capture, else 4ddress."""
    label_source: Literal["auto", "scan", "views", "body"] = "auto"
    """Labels that come with the scan, votes of its views' label maps, or what the body in the scan and its colours say.
    auto: the first of views, scan and body that there is. Labels of a scan are what nobody has of a person that was
    photographed."""
    protocol: OptionalText = None
    """With --capture: the protocol whose parameters and labels are used; later commands on the run keep to it."""
    frame: int = 0
    """Reference frame, near T-pose."""
    body: OptionalPath = None
    """SMPL-X-layout body file; the open body by default."""
    register: Literal["auto", "on", "off"] = "auto"
    """Register the body to the capture (or to the scan) before anything else, starting from the parameters if there are
    any. auto: where the capture says that its parameters are tracked, where it has keypoints and no parameters, and
    where `smplxpp register` has written into this run."""
    units: Literal["auto", "m", "cm", "mm", "inch"] = "auto"
    """Units of the scan file. auto: found where the scan comes alone, else those of the parameters, metres."""
    up: Literal["auto", "y", "z", "x", "-y", "-z", "-x"] = "auto"
    """Upward axis of the scan file. auto: found where the scan comes alone, else +Y."""
    keep_webs: bool = False
    """Keep the scan's surface where it bridges two limbs, as under the arms; it tears when the pose opens them."""
    method: Literal["ours", "paper"] = "ours"
    """Skin-weight transfer: ours, or robust transfer exactly as published."""
    budgets: Annotated[
        dict[str, int], tyro.conf.arg(metavar="PART FACES [PART FACES ...]", help_behavior_hint="(optional)")
    ] = field(default_factory=dict)
    """Faces kept by part, for instance `--budgets upper 10000 hair 4000`; others keep their default."""
    clearance_mm: float = 1.0
    """Distance kept between layers, 0.1 to 10."""
    max_influences: int = 8
    """Joints that a vertex may follow."""
    samples: int = 100_000
    """Surface samples of the validation."""
    seed: int = 0
    """Seed of the samples."""
    from_stage: StageName = BUILD_STAGES[0]
    """First stage to run; earlier ones must stand."""
    until_stage: StageName = BUILD_STAGES[-1]
    """Last stage to run."""
    no_report: bool = False
    """Leave out report.html, the pictures of every stage."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict:
        """Build, write metrics.json and the report, print the summary."""
        from pipelines.commands.inspect import Inspect
        from pipelines.report.sections.build import write_build_report
        from pipelines.stages.build import build
        from smplxpp.register.landmark_file import read_landmarks
        from smplxpp.segment import Corrections

        keep_out_of_capture(self.out, self.capture)
        config, inputs = self.config(), self.inputs()
        take_file(self.out, LANDMARKS_FILE, self.landmarks, read=read_landmarks)
        take_file(self.out, CORRECTIONS_FILE, self.corrections, read=Corrections.load)
        bounds = BUILD_STAGES.index(self.from_stage), BUILD_STAGES.index(self.until_stage)
        count = sum(name in inputs.stages for name in BUILD_STAGES[bounds[0] : bounds[1] + 1])
        whole = self.until_stage == BUILD_STAGES[-1] and not self.no_report
        with stage_progress(count + whole, enabled=not self.json) as step:
            records = build(
                self.out,
                inputs,
                config,
                registration=self.registration(inputs),
                reconstruction=self.reconstruction(inputs),
                first=self.from_stage,
                last=self.until_stage,
                progress=step,
            )
            if whole and not self._report_stands(records):
                step("report", False)
                write_build_report(self.out, inputs, config, records)
                step("report", True)
        if not self.json:
            Inspect(run_folder=self.out).run()
        metrics = read_json(self.out / "metrics.json", subject="metrics")
        failed = sum(check["status"] == "fail" for check in metrics["checks"])
        return {**metrics, "failed": failed, "exit_status": 0}

    def _report_stands(self, records: dict[str, StageRecord]) -> bool:
        """Whether the report was written after every stage, those of other commands among them."""
        report = self.out / "report.html"
        manifests = [record.folder / "manifest.json" for record in records.values()]
        manifests += [
            self.out / name / "manifest.json" for name in (REFINE_STAGE, BIND_STAGE, *TRAIN_STAGES, EVALUATE_STAGE)
        ]
        made = [path.stat().st_mtime_ns for path in manifests if path.exists()]
        return report.is_file() and report.stat().st_mtime_ns > max(made)

    def inputs(self) -> BuildInputs:
        """The files of this build.

        Raises:
            InputError: neither or both ways of naming the input, or files that a capture lacks.
        """
        if (self.capture is None) == (self.scan is None):
            raise InputError(
                "input",
                expected="either --capture or --scan",
                received="both" if self.capture else "neither",
            )
        label_set = self.label_set
        if self.capture is not None:
            registered = self._registers()
            found = find_reference(
                self.capture,
                frame=self.frame,
                params=self.params,
                protocol=self.protocol,
                fitted=not registered,
                scanned=False,
            )
            labels = self.labels or self._scan_labels(found)
            by_body = self.label_source == "body"
            return BuildInputs(
                subject=found.subject,
                scan=found.scan or self.out / reconstructed_scan(found.frame),
                params=None if registered else found.params,
                reconstructs=found.scan is None,
                locates=registered and not self._starts(found),
                registers=registered,
                frame=found.frame,
                params_row=found.params_frame,
                labels=labels,
                label_maps={} if labels or by_body else found.label_maps,
                photographs=dict(spread(list(found.photographs.items()), MOST_PHOTOGRAPHS)),
                cameras=found.cameras_file if found.photographs or not labels else None,
                label_set="capture" if label_set == "auto" else label_set,
                label_source="body" if by_body else "auto",
                motion=None if registered else found.motion,
                body=self.body,
                protocol=self.protocol,
            )
        for name in ("protocol", "keypoints", "masks"):
            if getattr(self, name) is not None:
                raise InputError(f"option {name}", expected="with --capture", received="with --scan")
        assert self.scan is not None
        registers = self.params is not None and self.register == "on"
        return BuildInputs(
            subject=self.scan.stem,
            scan=self.scan,
            params=None if registers else self.params,
            registers=registers,
            locates=self.params is None,
            frame=self.frame,
            params_row=self.frame,
            labels=self.labels,
            label_set="4ddress" if label_set == "auto" else label_set,
            label_source="body" if self.label_source == "body" else "auto",
            body=self.body,
        )

    def _registers(self) -> bool:
        """Whether the parameters come from a registration of the capture."""
        assert self.capture is not None
        if self.register != "auto":
            return self.register == "on"
        if self._standing_registration() is not None:
            return True
        if not self.capture.is_dir():
            return False
        said = SaidOfInputs.of_folder(self.capture, self.protocol)
        params = said.own_parameters() if self.params is None else named_params(self.capture, self.params)
        return params is None or said.given_parameters(params) == TRACKED

    def _starts(self, found: ReferenceFrame) -> bool:
        """Whether a registration has something to start from: a fit, keypoints, or that it stands."""
        assert self.capture is not None
        if found.params is not None or self.keypoints is not None or self._standing_registration() is not None:
            return True
        files = choose_protocol(self.capture, read_description(self.capture), self.protocol)
        return files.keypoints is not None and (self.capture / files.keypoints).is_dir()

    def _standing_registration(self) -> RegisterInputs | None:
        """What `smplxpp register` has made in this run of this capture, from these parameters if any are named."""
        found = load_register(self.out)
        if (
            found is None
            or found.capture is None
            or self.capture is None
            or read_manifest(self.out / REGISTER_STAGE) is None
        ):
            return None
        params = named_params(self.capture, self.params)
        same = same_place(found.capture, self.capture) and found.protocol == self.protocol
        return (
            found
            if same and (params is None or (found.params is not None and same_place(params, found.params)))
            else None
        )

    def registration(self, inputs: BuildInputs) -> RegisterInputs | None:
        """What the body is registered to, None where the parameters are given."""
        if not inputs.registers:
            return None
        return self._standing_registration() or RegisterInputs(
            capture=self.capture,
            params=named_params(self.capture, self.params),
            protocol=self.protocol,
            body=self.body,
            scan=inputs.scan if inputs.reconstructs else self.scan,
            frame=self.frame,
            labels=inputs.labels,
            label_set=inputs.label_set,
            keypoints=self.keypoints,
            masks=self.masks,
            units="m" if self.units == "auto" else self.units,
            up="y" if self.up == "auto" else self.up,
        )

    def reconstruction(self, inputs: BuildInputs) -> ReconstructInputs | None:
        """The photographs that the scan is made of, None where there is one; what `smplxpp reconstruct` has made of
        this frame stands."""
        if not inputs.reconstructs:
            return None
        assert self.capture is not None
        found = load_reconstruct(self.out)
        if found is not None and inputs.scan.is_file() and same_place(found.capture, self.capture):
            return found
        return ReconstructInputs(self.capture, frames=(self.frame,), masks=self.masks, protocol=self.protocol)

    def _scan_labels(self, found: ReferenceFrame) -> Path | None:
        """The labels that come with the scan, if they are used; None where the views' label maps are, or the body's.

        Raises:
            InputError: the labels that are asked for are not there.
        """
        views, scan = bool(found.label_maps), found.scan_labels is not None
        if self.label_source in ("views", "scan") and not {"views": views, "scan": scan}[self.label_source]:
            barred = f", by protocol {self.protocol}" if self.protocol else ""
            raise InputError(
                f"capture {found.subject}",
                expected={"scan": "labels of the scan", "views": "label maps of its views"}[self.label_source],
                received=f"none for frame {found.frame}{barred}",
                remedy="name a file with --labels",
            )
        if self.label_source == "body" or (views and self.label_source != "scan") or not scan:
            return None
        if self.label_source == "auto":
            log.warning(
                "no label maps of frame %d: the labels that come with the scan are used, which are no estimate",
                found.frame,
            )
        return found.scan_labels

    def config(self) -> BuildConfig:
        """The choices of this build.

        Raises:
            InputError: a budget for an unknown part, or numbers out of range.
        """
        default = BuildConfig()
        unknown = sorted(set(self.budgets) - set(default.budgets))
        if unknown:
            raise InputError(
                "option budgets", expected=f"parts among {', '.join(default.budgets)}", received=", ".join(unknown)
            )
        for name, value, least, most in (
            ("clearance-mm", self.clearance_mm, 0.1, 10.0),
            ("max-influences", self.max_influences, 1, math.inf),
            ("samples", self.samples, 1000, math.inf),
            ("seed", self.seed, 0, math.inf),
            ("frame", self.frame, 0, math.inf),
            ("budgets", min(self.budgets.values(), default=100), 100, math.inf),
        ):
            if not (least <= value <= most and math.isfinite(value)):
                limit = f" and at most {most:g}" if math.isfinite(most) else ""
                raise InputError(
                    f"option {name}", expected=f"a finite number, at least {least:g}{limit}", received=f"{value:g}"
                )
        alone = self.scan is not None and self.params is None
        changed = {
            "units": self.units if alone or self.units != "auto" else "m",
            "up": self.up if alone or self.up != "auto" else "y",
            "budgets": default.budgets | self.budgets,
            "webs": replace(default.webs, rounds=0) if self.keep_webs else default.webs,
        }
        names = {f.name for f in dataclasses.fields(BuildConfig)} - set(changed)
        return BuildConfig(**{n: getattr(self, n) for n in names}, **changed)
