"""`smplxpp evaluate`: the models of a run measured on a capture; figures, tables, pictures and a report out."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from pipelines.commands.options import ClothMode, Lighting, OptionalPath, OptionalText, require_avatar
from pipelines.commands.terminal import print_paths, shared_progress
from pipelines.runs.layout import STUDENT
from smplxpp.core.errors import InputError
from smplxpp.core.light import STUDIO, Irradiance, Relighting, panoramas

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Evaluate:
    """Options of `smplxpp evaluate`."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder with a template and trained models; the evaluation goes into it as 95_evaluate."""
    capture: Path
    """Folder of the capture: cameras, images, masks, body parameters; true meshes where it has them."""
    models: tuple[Literal["fit", "teacher", "baked", "student", "compact"], ...] = ()
    """Models to measure; by default fit, teacher and student, as far as the run has them. baked: the student before its
    blend shapes. compact: its file for players."""
    sets: tuple[Literal["training", "novel_view", "novel_pose", "novel_pose_training_view"], ...] = ()
    """View sets to measure; by default training views and every set with held-out cameras or frames."""
    every: int = 1
    """Measure every n-th held-out frame, and every n-th training frame in held-out cameras."""
    training_every: int = 4
    """Every n-th training frame of the training views and of the true surfaces; never more often than --every."""
    hold_out: tuple[str, ...] = ()
    """Cameras that count as held out, in the place of the capture's."""
    hold_out_frames: tuple[int, ...] = ()
    """Frames that count as held out, in the place of the capture's."""
    protocol: OptionalText = None
    """Protocol of the capture, whose parameters, labels and normals are read; by default the one of the build."""
    held_out_poses: Literal["tracked", "both"] = "both"
    """Poses of held-out frames: as tracked, or beside them those that the run refined on the training cameras, where it
    has any."""
    cloth: ClothMode = "simulate"
    """What moves the loose clothes of a student in held-out poses: a simulation, where the run has found loose parts;
    its field; or skinning alone."""
    params: OptionalPath = None
    """Stacked body parameters to take instead of the capture's own, the same as for the training."""
    body: OptionalPath = None
    """SMPL-X-layout body file that the parameters are for; the open body by default."""
    scale: float = 1.0
    """Size of the images to compare, 1 for every pixel."""
    metric: Literal["auto", "st-lpips", "lpips", "both", "none"] = "auto"
    """Perceptual distance; auto: ST-LPIPS where stlpips-pytorch is installed, and LPIPS where its weights are at hand:
    --lpips-weights, or package lpips and the AlexNet that torchvision downloaded."""
    lpips_weights: tuple[Path, ...] = ()
    """Weights of LPIPS: a state of the package lpips, or torchvision's AlexNet or VGG16 and the package's own."""
    samples: int = 100_000
    """Points of a mesh for its distance to the truth; 0 leaves the surface out."""
    speed_size: tuple[int, int] = (512, 512)
    """Width and height of the pictures that are timed."""
    speed_pictures: int = 20
    """Pictures that are timed; 0 leaves the speed out."""
    shown: int = 2
    """Views of each set to keep pictures of."""
    lighting: Annotated[Lighting, tyro.conf.arg(name="")] = field(default_factory=Lighting)
    """The other light that the report shows the student in; by default two lamps of a studio."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes CUDA where it is."""
    seed: int = 0
    """Seed of the points on the surfaces."""
    force: bool = False
    """Measure again even if the evaluation is up to date."""
    no_report: bool = False
    """Leave report.html as it is."""
    json: bool = False
    """Print the figures as JSON."""

    def run(self) -> dict:
        """Measure, write the report, print the tables."""
        require_avatar("evaluating avatars")
        from avatar.evaluation.evaluate import EvaluationConfig
        from avatar.evaluation.protocol import ProtocolConfig
        from avatar.evaluation.report import EvalReport
        from avatar.evaluation.summary import evaluation_tables
        from avatar.training.engine.resources import choose_device
        from pipelines.report.sections.build import rewrite_report
        from pipelines.runs.folders import keep_out_of_capture
        from pipelines.stages.evaluate import evaluate
        from pipelines.stages.evaluate_inputs import REPORT_FILE
        from pipelines.stages.scene import TrainInputs

        # Check options and read the light before models are loaded.
        keep_out_of_capture(self.run_folder, self.capture, subject="RUN")
        protocol = ProtocolConfig(
            sets=self.sets,
            every=self.every,
            training_every=self.training_every,
            held_out_frames=self.hold_out_frames,
        )
        if min(self.speed_size) < 1:
            raise InputError("option speed-size", expected="two numbers above 0", received=str(self.speed_size))
        config = EvaluationConfig(
            protocol=protocol,
            metric=_metric(self.metric, self.lpips_weights),
            lpips_weights=self.lpips_weights,
            samples=self.samples,
            seed=self.seed,
            speed_size=self.speed_size,
            speed_pictures=self.speed_pictures,
            shown=self.shown,
        )
        lights = self._lights()
        inputs = TrainInputs(self.capture, self.params, self.body, self.hold_out, self.scale, self.protocol)
        # An evaluation that is up to date returns its record at once.
        with shared_progress(enabled=not self.json) as progress:
            record = evaluate(
                self.run_folder,
                inputs,
                config,
                models=self.models,
                refined=self.held_out_poses == "both",
                cloth=self.cloth,
                device=choose_device(self.device),
                force=self.force,
                progress=progress,
            )
        page, ran = self.run_folder / "report.html", record.ran
        # Only a student can be relit; its pictures go to a stage of their own.
        if (self.run_folder / STUDENT).is_file():
            from pipelines.stages.relight import relight

            shown = self.lighting.environment
            relit = relight(self.run_folder, STUDIO if shown is None else shown.stem, lights, force=self.force)
            ran = ran or relit.ran
        # The page is rewritten if it lacks the new figures.
        if not self.no_report and (ran or not page.is_file()) and rewrite_report(self.run_folder) is None:
            log.warning("the run has no record of its build: `smplxpp build` writes the report with it")
        # Print from the file, so that figures of an earlier evaluation look the same.
        report = EvalReport.load(record.folder / REPORT_FILE)
        if not self.json:
            console = Console()
            for table in evaluation_tables(report).values():
                console.print(table.text(width=console.width), highlight=False, soft_wrap=True)
            console.print(
                f"{'' if record.ran else 'stands, not run again; '}tables  {record.folder / 'tables'}\n"
                f"views   {record.folder / 'pictures'}",
                soft_wrap=True,
                highlight=False,
            )
            print_paths({"report": page if page.is_file() else None}, console)
        return {**report.as_dict(), "run": str(self.run_folder), "ran": record.ran, "checks": record.manifest["checks"]}

    def _lights(self) -> dict[str, Relighting]:
        """Return the lights of the report's pictures by their captions."""
        turns = (0.0, 120.0, 240.0)  # rotations of the light about the vertical for the report's pictures, degrees
        out = {}
        for turn in turns:
            turned = replace(self.lighting, environment_turn=self.lighting.environment_turn + turn)
            # Without a panorama, turn our studio light; white light is assumed for the capture.
            lit = (self.lighting if self.lighting.environment is None else turned).relighting()
            if lit is None:
                studio = Irradiance.of_environment(panoramas()[STUDIO], turn=turn)
                lit = Relighting(studio.exposed(), Irradiance.uniform())
            out["relit" if turn == 0.0 else f"the light turned by {turn:.0f} degrees"] = lit
        return out


def _metric(name: str, weights: tuple[Path, ...] = ()) -> str:
    """Return the name of the metric; "auto" is ST-LPIPS where it is installed, LPIPS where it is at hand, or both."""
    if weights and name in ("st-lpips", "none"):
        raise InputError("option lpips-weights", expected="metric auto, both or lpips", received=f"metric {name}")
    if name != "auto":
        return name
    from avatar.losses.perceptual_weights import load_lpips, lpips_at_hand

    if weights:
        load_lpips(weights)  # files of other weights are refused before anything is measured
    shift_tolerant, plain = find_spec("stlpips_pytorch") is not None, bool(weights) or lpips_at_hand()
    if shift_tolerant or plain:
        return "both" if shift_tolerant and plain else "st-lpips" if shift_tolerant else "lpips"
    log.info("no perceptual distance is measured: stlpips-pytorch is not installed (pip install --no-deps)")
    return "none"
