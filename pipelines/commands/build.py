"""`smplxpp build`: a scan, a body fit and labels in; a template, its numbers and a report out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from pipelines.commands.options import OptionalFloat, OptionalInt, OptionalPath, OptionalText
from pipelines.commands.terminal import stage_progress
from pipelines.runs.folders import keep_out_of_capture
from pipelines.runs.layout import (
    ASSEMBLE_STAGE,
    BUILD_STAGES,
    CORRECTIONS_FILE,
    LANDMARKS_FILE,
    REGISTER_STAGE,
    reconstructed_scan,
)
from pipelines.runs.stage import read_manifest
from pipelines.stages.build_config import load_reconstruct, load_register
from smplxpp.body import Whose
from smplxpp.build.config import BuildConfig
from smplxpp.build.inputs import BuildPlan, plan_build
from smplxpp.build.request import BuildRequest
from smplxpp.capture import open_capture
from smplxpp.clean.remesh import require_remesher
from smplxpp.core import InputError
from smplxpp.core.files.json_file import read_json
from smplxpp.detect import load_detector

StageName = Literal[BUILD_STAGES]  # type: ignore[valid-type]


@dataclass(frozen=True)
class Build:
    """Options of `smplxpp build`. Give --capture, or --scan: alone, or with what is known of it."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of the run; finished stages in it are not run again."""
    capture: OptionalPath = None
    """Folder of a capture: photographs, cameras and masks; scans/scan_FFFFFF.ply, params/, labels as far as there are
    any. A scan that there is not is reconstructed, and the body is found."""
    scan: OptionalPath = None
    """Clothed scan of the reference frame (PLY, OBJ, GLB, STL, OFF, npz)."""
    params: OptionalPath = None
    """Body parameters of that frame, any layout that `smplxpp params convert` reads. Without them the body is found in
    the scan."""
    labels: OptionalPath = None
    """Labels of the scan's vertices or faces: npz, npy, 4D-Dress pickle, or a coloured mesh. Where neither they, nor
    the scan, nor label maps of its views say what is what, the body in the scan and its colours do."""
    keypoints: OptionalPath = None
    """With --capture: folder of keypoints, of `smplxpp keypoints detect` or any other detector, in the place of its
    own."""
    masks: OptionalPath = None
    """With --capture: folder of masks, in the place of its own."""
    landmarks: OptionalPath = None
    """Landmarks of the scan, a JSON object of points by name: they tell where the body is that is not given. Kept in
    the run as landmarks.json, which is read whenever it lies there."""
    corrections: OptionalPath = None
    """Labels corrected by hand, as `smplxpp label` writes them. Kept in the run as labels_corrections.json, which is
    read whenever it lies there."""
    label_set: str = "auto"
    """Label set of the labels: 4ddress, capture, lip, cihp, atr, pascal, sapiens, or a file: a labels.yaml of your own
    classes (coat over shirt, socks, glasses, a bag), or a JSON object that maps ids to names.
    auto: `capture` with --capture, else 4ddress."""
    label_source: Literal["auto", "scan", "views", "body"] = "auto"
    """Labels that come with the scan, votes of its views' label maps, or what the body in the scan and its colours say.
    auto: the first of views, scan and body that there is. A photographed person has no such labels."""
    protocol: OptionalText = None
    """With --capture: the protocol whose parameters and labels are used; later commands on the run keep to it."""
    frame: OptionalInt = None
    """Reference frame, near T-pose; by default 0, or the first training frame of a capture that counts from another
    number."""
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
    height: OptionalFloat = None
    """The person's stature in metres (1.75), for a scan that comes alone and has no unit: voxels, data scaled to 1,
    photogrammetry. In any pose: the body that is found in the scan gets it."""
    whose: Whose = "auto"
    """With --scan: whose --params are. auto: as their counts and keys tell. SMPL's, SMPL-H's and SMPL-X's are a start
    where the body is the open body: limbs and front are taken from them, shape and place are found in the scan."""
    detector: OptionalText = None
    """Keypoint model that tells front and limbs of a scan without parameters: `mediapipe` (extra detect), or a
    pose model in ONNX."""
    keep_bridges: bool = False
    """Keep faces of the scan that bridge two limbs, as under the arms; they tear when a pose opens the gap."""
    keep_holes: bool = False
    """Leave the holes of cut bridges open, instead of closing them with patches of least area."""
    method: Literal["ours", "paper"] = "ours"
    """Skin-weight transfer: ours, or robust transfer exactly as published."""
    budgets: Annotated[
        dict[str, int], tyro.conf.arg(metavar="PART FACES [PART FACES ...]", help_behavior_hint="(optional)")
    ] = field(default_factory=dict)
    """Faces kept by part, for instance `--budgets upper 10000 hair 4000`; others keep their default."""
    rules: Annotated[
        dict[str, str], tyro.conf.arg(metavar="PART RULE [PART RULE ...]", help_behavior_hint="(optional)")
    ] = field(default_factory=dict)
    """How parts follow the skeleton: `--rules upper/1 rigid:spine3 outer chain:spine3,neck`. rigid:JOINT, chain:JOINTS,
    isolate (each piece rigid by the joint nearest to it) or auto; upper/1 is the second largest piece of upper."""
    remesh: Literal["quadric", "isotropic"] = "quadric"
    """Remeshing of the parts: quadric edge collapse, or isotropic remeshing to faces of one size by pymeshlab (extra
    remesh; GPL-3)."""
    clearance_mm: float = 1.0
    """Distance kept between layers, 0.1 to 10."""
    max_influences: int = 8
    """Largest number of joints with weight at a vertex."""
    texture_size: Literal[0, 1024, 2048, 4096] = 2048
    """Texels a side of the template's texture, painted from the scan's own or from the photographs; 0: vertices are
    coloured instead."""
    texture_layout: Literal["one", "part"] = "one"
    """One picture for all parts, or one a part; then the body lies as in its own file."""
    normal_map: bool = False
    """Paint the scan's normals onto the parts, too: for small budgets of faces."""
    samples: int = 100_000
    """Surface samples of the validation."""
    seed: int = 0
    """Seed of the samples."""
    from_stage: StageName = BUILD_STAGES[0]
    """First stage to run; earlier ones must stand."""
    until_stage: StageName = BUILD_STAGES[-1]
    """Last stage to run."""
    accept_failures: bool = False
    """Build on a body that was found with too little confidence, and end with status 0 although checks fail."""
    no_report: bool = False
    """Leave out report.html, the pictures of every stage."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self, assembled: Callable[[], object] = lambda: None) -> dict:
        """Build, write metrics.json and the report, print the summary; the exit status is 1 where checks fail.

        Args:
            assembled: called when the template stands, before it is validated and shown.
        """
        from pipelines.commands.inspect import Inspect
        from pipelines.report.sections.build import update_build_report
        from pipelines.stages.build import build

        # Decide on inputs and tools first; a wrong option must not end a build after minutes.
        keep_out_of_capture(self.run_folder, self.capture, subject="RUN")
        plan = self.plan()
        self._check_tools()
        # The bar counts the steps that this build has between its first and its last stage, and the report.
        bounds = BUILD_STAGES.index(self.from_stage), BUILD_STAGES.index(self.until_stage)
        names = [stage.partition("_")[2] for stage in BUILD_STAGES[bounds[0] : bounds[1] + 1]]
        count = sum(name in plan.inputs.steps for name in names)
        whole = self.until_stage == BUILD_STAGES[-1] and not self.no_report
        with stage_progress(count + whole, enabled=not self.json) as step:

            def told(name: str, done: bool) -> None:
                step(name, done)
                if done and name == ASSEMBLE_STAGE:
                    assembled()

            build(
                self.run_folder,
                plan.inputs,
                plan.config,
                registration=plan.registration,
                reconstruction=plan.reconstruction,
                by_hand={LANDMARKS_FILE: self.landmarks, CORRECTIONS_FILE: self.corrections},
                first=self.from_stage,
                last=self.until_stage,
                progress=told,
                report=None if self.no_report else update_build_report,
            )
        # Print the same summary as `smplxpp inspect`.
        if not self.json:
            Inspect(run_folder=self.run_folder).run()
        metrics = read_json(self.run_folder / "metrics.json", subject="metrics")
        failed = sum(check["status"] == "fail" for check in metrics["checks"])
        return {**metrics, "failed": failed, "exit_status": int(failed > 0 and not self.accept_failures)}

    def plan(self) -> BuildPlan:
        """Decide which inputs and stages this build uses.

        Raises:
            InputError: neither or both ways of naming the input, files that a capture lacks, or choices out of range.
        """
        return plan_build(self.request())

    def request(self) -> BuildRequest:
        """Turn the options into one request, with what earlier commands have made in the run."""
        # Earlier commands on this run leave registration and reconstruction, which the plan may use.
        registered = read_manifest(self.run_folder / REGISTER_STAGE) is not None
        return BuildRequest(
            scan=self.scan,
            capture=self.capture,
            params=self.params,
            labels=self.labels,
            body=self.body,
            config=self.config(),
            surface=self.run_folder / reconstructed_scan(self.reference_frame()),
            registration=load_register(self.run_folder) if registered else None,
            reconstruction=load_reconstruct(self.run_folder),
        )

    def reference_frame(self) -> int:
        """Return the frame of the option, else 0, or the first that a capture without a frame 0 trains on."""
        if self.frame is not None or self.capture is None:
            return self.frame or 0
        with suppress(InputError):  # the plan says what is wrong with the capture
            frames = open_capture(self.capture).splits.train_frames
            return frames[0] if frames and 0 not in frames else 0
        return 0

    def config(self) -> BuildConfig:
        """Collect the choices of this build.

        Raises:
            InputError: a budget for an unknown part, or numbers out of range.
        """
        default = BuildConfig()
        # A file is found from every folder.
        own = Path(self.label_set)
        changed: dict[str, Any] = {
            "label_set": str(own.absolute()) if own.is_file() else self.label_set,
            "bridges": replace(default.bridges, rounds=0) if self.keep_bridges else default.bridges,
            "fill_holes": replace(default.fill_holes, width=0.0) if self.keep_holes else default.fill_holes,
            # Landmarks and corrections lie in the run, where every stage finds them.
            "landmarks": None,
            "corrections": None,
            "frame": self.reference_frame(),
        }
        names = {f.name for f in dataclasses.fields(BuildConfig)} - set(changed)
        return BuildConfig(**{n: getattr(self, n) for n in names}, **changed)

    def _check_tools(self) -> None:
        """Check that the detector and the remesher can be loaded, before work starts."""
        if self.detector is not None:
            load_detector(self.detector)
        require_remesher(self.remesh)
