"""`smplxpp train`: a capture and a template in; a teacher, a student, their figures and a report out."""

from __future__ import annotations

import logging
import math
import os
import shutil
import time
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.table import Table

from pipelines.commands.options import OptionalFloat, OptionalInt, OptionalPath, OptionalText, require_avatar
from pipelines.commands.terminal import print_paths, training_progress
from pipelines.runs.artefacts import values_of
from pipelines.runs.layout import FIT_STAGE
from pipelines.runs.stage import StageRecord, how_to_continue
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import parse_json

if TYPE_CHECKING:
    from avatar.training.recipe import TrainConfig
    from avatar.training.refinement.config import RefineConfig
    from avatar.training.scene import TrainScene
    from pipelines.stages.scene import TrainInputs

log = logging.getLogger(__name__)
# As `avatar.training.recipe` has them, which would pull torch into `smplxpp train --help`.
STEPS = ("refine", "fit", "teacher", "cloth", "bake", "compensate")


@dataclass(frozen=True)
class Train:
    """Options of `smplxpp train`. It trains what a run lacks; the same command continues with what was interrupted."""

    run_folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder that `smplxpp build` wrote; 66_refine, 70_fit, 80_teacher, 83_cloth, 85_bake and 90_compensate go into
    it."""
    capture: Path
    """Folder of the capture: cameras, images, masks and body parameters of its frames."""
    preset: Literal["paper", "gpu", "paper-small", "cpu", "demo"] = "cpu"
    """paper: the published numbers, for a GPU (docs/training.md lists the others). gpu: smaller, some hours.
    paper-small: the paper's recipe in the time of cpu. cpu: half an hour on two cores. demo: minutes, to check the
    inputs."""
    stage: Annotated[
        Literal["refine", "teacher", "cloth", "bake", "compensate"] | None,
        tyro.conf.arg(metavar="{refine,teacher,cloth,bake,compensate}", help_behavior_hint="(optional)"),
    ] = None
    """Train this stage alone; those before it must stand."""
    until: Literal["refine", "fit", "teacher", "cloth", "bake", "compensate"] = "compensate"
    """The last stage to train."""
    refine_poses: Literal["auto", "on", "off"] = "auto"
    """Refine the poses of the training frames on the photographs first; all later stages use them. auto: if the capture
    declares its parameters as tracked, or the run has registered or refined some."""
    refine_cameras: bool = False
    """Refine the poses of the training cameras together with the body poses. Their mean, all intrinsics and held-out
    cameras stay fixed. For slightly wrong calibrations of many cameras."""
    refine_frames: int = 200
    """Frames of a chunk of the refinement, which several processes share (docs/batch.md)."""
    refine_gaussians: OptionalInt = None
    """Number of Gaussians that carry the colours of the refinement, by default 30,000. Photographs of few pixels need
    fewer, and the refinement is faster; the head keeps its 4,500."""
    refine_help: bool = False
    """Help other processes with the refinement of the same run, chunk by chunk, and leave its end to one without this
    option."""
    max_minutes: float = math.inf
    """Stop after this many minutes and write the models reached so far. The same command then resumes, without --force,
    which would start again."""
    iterations_share: OptionalFloat = None
    """Fraction of the preset's iterations, for all stages."""
    fit_iterations: OptionalInt = None
    """Iterations of the fit, in the place of the preset's."""
    teacher_iterations: OptionalInt = None
    """Iterations of the teacher."""
    bake_iterations: OptionalInt = None
    """Iterations of the bake."""
    compensate_iterations: OptionalInt = None
    """Iterations of the compensation."""
    batch: OptionalInt = None
    """Poses in a step of every training. With several processes there is at least one for each."""
    gaussians: OptionalInt = None
    """Number of Gaussians of the fit."""
    blend_shapes: Literal["full", "local", "pruned"] = "full"
    """full: as published; local: 256 parts with coefficients of their own and 16 columns; pruned: full, and the compact
    file keeps those that move and colour most."""
    max_megabytes: float = 20.0
    """Size of the compact file with pruned blend shapes."""
    no_teacher: bool = False
    """Bake from the photographs alone, without stage 80."""
    cloth: Literal["auto", "none"] = "auto"
    """Clothes to simulate in new motion. auto: garments that deviate from skinning in the photographs and that a
    simulation reproduces better. none: the student's field moves all clothes."""
    loose_parts: tuple[str, ...] = ()
    """Simulate these parts, in the place of what --cloth auto finds: names as `smplxpp inspect` lists them."""
    perceptual: Literal["auto", "lpips", "st-lpips", "none"] = "auto"
    """Metric of the perceptual term. auto: LPIPS or else ST-LPIPS where the preset has the term and the package is
    installed; a name gives the term to any preset."""
    hold_out: tuple[str, ...] = ()
    """Cameras to keep from training and to measure on; by default those that the capture holds out."""
    protocol: OptionalText = None
    """Protocol of the capture, whose parameters, labels and normals are read; by default the one of the build."""
    params: OptionalPath = None
    """Body parameters to take instead of the capture's own, the same as for the build."""
    body: OptionalPath = None
    """SMPL-X-layout body file that the parameters are for; the open body by default."""
    scale: float = 1.0
    """Size of the images to work on, 1 for every pixel."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes CUDA where it is."""
    processes: OptionalInt = None
    """Processes of this machine that train together, one for each GPU; 0: as many as there are GPUs. They share the
    poses of a step, which changes batches and rates (docs/training.md); by default one."""
    seed: int = 0
    """Seed of all random numbers."""
    force: bool = False
    """Train again even what is up to date, and delete checkpoints. A fit by `smplxpp fit` is kept."""
    tensorboard: bool = False
    """Log for TensorBoard too, into the folders of the stages."""
    checkpoint_minutes: OptionalFloat = None
    """Minutes between checkpoints; by default half a minute, or longer for writing to take 2 % of the time."""
    surface_normals: Literal["preset", "on", "off"] = "preset"
    """Compare normals with those of the followed clothes where the capture has no normal maps."""
    precision: Literal["preset", "tf32", "float32", "bfloat16"] = "preset"
    """Of networks on a GPU. tf32, as all presets have: convolutions of inputs with 11 bits; bfloat16: networks of 8."""
    compile: Literal["off", "graphs", "inductor"] = "off"
    """On a GPU, record the teacher's networks as CUDA graphs, or compile them by torch, for minutes; what fails, or
    gives other numbers, computes as before, which is said."""
    readers: OptionalInt = None
    """Threads that decode photographs; by default one, and beside a GPU as many as CPUs, at most eight."""
    cache_gib: OptionalFloat = None
    """GiB of memory for photographs that are kept; by default 1."""
    no_report: bool = False
    """Leave report.html as it is."""
    dry_run: bool = False
    """Print hours, gigabytes, memory and disk of each stage, and train nothing; see docs/batch.md."""
    rates: OptionalPath = None
    """With --dry-run: JSON with rates of this machine, as `smplxpp batch --rates` takes it."""
    json: bool = False
    """Print the summary as JSON."""

    def run(self) -> dict[str, Any] | None:
        """Train, write the report, print the figures; None where another process answers, or printed its answer."""
        require_avatar("training an avatar")
        if int(os.environ.get("RANK") or 0):
            logging.disable(logging.WARNING)  # rank 0 logs the same warnings
        from avatar.data.one_frame import views_of_turn
        from avatar.training.engine.processes import join_processes
        from avatar.training.engine.resources import choose_device, count_gpus
        from avatar.training.recipe import with_processes
        from pipelines.runs.folders import keep_out_of_capture
        from pipelines.stages.models import TrainOptions
        from pipelines.stages.refine import wants_refinement
        from pipelines.stages.scene import TrainInputs, open_scene
        from pipelines.stages.train import train

        # Check options before processes are joined, so that every process fails alike.
        keep_out_of_capture(self.run_folder, self.capture, subject="RUN")
        inputs = TrainInputs(self.capture, self.params, self.body, self.hold_out, self.scale, self.protocol)
        config, steps = self.config(), self.steps()
        config.recipe(self.preset, cloth=self.cloth)
        if self.dry_run:
            refines = wants_refinement(self.run_folder, inputs, self.refine_poses)
            return self._plan(choose_device(self.device) == "cuda", steps, refines=refines)
        gpus = count_gpus(choose_device(self.device))
        if "WORLD_SIZE" not in os.environ and self.processes not in (None, 1):
            return self._together(gpus)
        if self.processes is None and gpus > 1 and "WORLD_SIZE" not in os.environ:
            log.info("%d GPUs are visible and one trains; with --processes 0 all do (docs/training.md)", gpus)
        with join_processes(choose_device(self.device)) as together:
            # Rank 0 decides and all open the scene, whose digests say that they train on the same data.
            first = together.run_on_rank0(lambda: wants_refinement(self.run_folder, inputs, self.refine_poses))
            refines = first and "refine" in steps
            scene = together.run_on_all(
                lambda: open_scene(self.run_folder, inputs, refined=not refines), lambda opened: opened.digests
            )
            recipe = config.recipe(self.preset, cloth=self.cloth, turn_views=views_of_turn(scene.capture))
            # Every process needs a pose of each step.
            preset = with_processes(recipe.preset, together.world_size)
            if together.first and preset != recipe.preset:
                log.info("batches grow to %d poses, with fewer steps at larger rates", together.world_size)
            recipe = replace(recipe, preset=preset, refine=config.refinement(wanted=first))
            if not recipe.teacher and self.stage in ("teacher", "cloth"):
                raise InputError(
                    "option stage",
                    expected="fit, bake or compensate",
                    received=f"{self.stage}, which the training of a turn and one without a teacher do not have",
                )
            held_out = bool(scene.capture.splits.novel_view_cameras)

            def bar(name: str, total: int) -> AbstractContextManager:
                return training_progress(name, total, held_out=held_out, enabled=not self.json and together.first)

            if self.refine_help:
                return self._help(inputs, scene, recipe.refine, together.device)
            options = TrainOptions(
                max_seconds=60.0 * self.max_minutes,
                force=self.force,
                tensorboard=self.tensorboard,
                checkpoint_seconds=config.checkpoint_seconds,
                bar=bar,
                precision=config.precision,
                compile=config.compile,
                readers=config.readers,
                cache_gib=config.cache_gib,
            )
            records = train(self.run_folder, inputs, scene, recipe, options, together, steps=steps)
            if not together.first:
                return None
        return self._finish(records)

    def _together(self, gpus: int) -> dict[str, Any] | None:
        """Run this command in processes of this machine, which train together, and answer as the first one does."""
        from pipelines.batch.process import own_program, run_together

        count = self.processes or max(gpus, 1)
        if count < 0 or count > (gpus or count):
            most = f"at most {gpus}, the number of GPUs" if gpus else "a number, at least 0"
            raise InputError("option processes", expected=most, received=str(count))
        # The words of a command line that gives these options.
        words = ["train", str(self.run_folder), "--processes", "1"]
        for one in fields(self)[1:]:
            value = getattr(self, one.name)
            if value != one.default and one.name != "processes":
                own = () if value is True else value if isinstance(value, tuple) else (value,)
                words += [f"--{one.name.replace('_', '-')}", *map(str, own)]
        program, variables = own_program()
        os.environ.update(variables)
        status, text = run_together([*program, *words], count, captured=self.json)
        answer = parse_json(text.encode(), subject="answer of the first process") if text.strip() else {}
        return {**answer, "exit_status": status} if status else answer or None

    def _plan(self, gpu: bool, steps: tuple[str, ...], *, refines: bool) -> dict[str, Any]:
        """Foretell what the stages take, as `smplxpp batch --dry-run` does for a fleet."""
        from avatar.training.engine.resources import foretell_memory
        from pipelines.batch.amounts import facts_of, recipe_of
        from pipelines.batch.page import cost_table
        from pipelines.batch.plan import training_costs
        from pipelines.batch.rates import read_rates

        facts = facts_of(self.capture, protocol=self.protocol, params=self.params, run=self.run_folder)
        if facts is None:
            raise InputError("capture", expected="one that can be opened", received=str(self.capture))
        held_out = len(self.hold_out) or facts.held_out_cameras
        facts = replace(facts, megapixels=facts.megapixels * self.scale**2, held_out_cameras=held_out)
        options = {**vars(self), "refine_poses": "on" if refines else "off"}
        costs = training_costs(facts, read_rates(self.rates)[0], options, gpu=gpu)
        costs = {step: cost for step, cost in costs.items() if step in steps}
        free = shutil.disk_usage(
            next(f for f in (self.run_folder, *self.run_folder.absolute().parents) if f.exists())
        ).free
        kept = sum(cost.written_gb for cost in costs.values())
        recipe = recipe_of(options, tracked=refines)
        cached = 1.0 if self.cache_gib is None else self.cache_gib
        memory = foretell_memory(
            recipe,
            megapixels=facts.megapixels,
            images=facts.images,
            frames=max(facts.frames, 1),
            cache_gib=cached,
            steps=steps,
        )
        if not self.json:
            Console().print(cost_table(costs, "stage"))
            where = "GiB of the GPU" if gpu else "GiB more for steps"
            told = ", ".join(f"{step} {one.host:.1f} + {one.device:.1f}" for step, one in memory.items())
            Console().print(f"GiB of memory + {where}: {told}", highlight=False)
            words = f"{facts.frames} frames of {facts.cameras} cameras, {facts.megapixels:.2f} megapixels"
            Console().print(f"{words}; {kept:.2f} GB are kept, {free / 1e9:.1f} GB are free", highlight=False)
        plan = {step: vars(cost) for step, cost in costs.items()}
        needs = {step: vars(one) for step, one in memory.items()}
        answer = {"run": str(self.run_folder), "facts": vars(facts), "plan": plan, "memory_gib": needs}
        return {**answer, "free_gb": free / 1e9}

    def _help(self, inputs: TrainInputs, scene: TrainScene, config: RefineConfig | None, device: str) -> dict[str, Any]:
        """Compute chunks of the refinement; nothing where poses are not refined, or are already."""
        from pipelines.stages.refine import help_refine

        until, finished = time.monotonic() + 60.0 * self.max_minutes, True
        if config is not None:
            stop = lambda: time.monotonic() > until  # noqa: E731
            finished = help_refine(self.run_folder, inputs, config, scene=scene, stop=stop, device=device)
        return {"run": str(self.run_folder), "finished": finished}

    def steps(self) -> tuple[str, ...]:
        """Return the steps to train, in order.

        Raises:
            InputError: options that exclude each other.
        """
        # Loose clothes are calibrated on the teacher's tracked surface, so that they need a teacher.
        if self.no_teacher and "teacher" in (self.stage, self.until):
            raise InputError("option no-teacher", expected="another last stage than the teacher", received="teacher")
        if self.loose_parts or "cloth" in (self.stage, self.until):
            asked = f"loose parts {' '.join(self.loose_parts)}" if self.loose_parts else "the stage cloth"
            if self.cloth == "none":
                raise InputError("option cloth", expected="auto", received=f"none, with {asked}")
            if self.no_teacher:
                raise InputError(
                    "option no-teacher",
                    expected="a teacher, to whose followed surface clothes are fitted",
                    received=f"none, with {asked}",
                )
        if self.refine_help and self.stage != "refine":
            raise InputError("option refine-help", expected="--stage refine", received=str(self.stage or "none"))
        if self.stage is not None:
            return (self.stage,)
        return STEPS[: STEPS.index(self.until) + 1]

    def config(self) -> TrainConfig:
        """Return the options as `avatar.train` takes them.

        Raises:
            InputError: numbers out of range.
        """
        from avatar.training.recipe import TrainConfig

        # Only given numbers are passed on; the rest comes from the preset.
        given = {step: getattr(self, f"{step}_iterations") for step in ("fit", "teacher", "bake", "compensate")}
        return TrainConfig(
            refine_cameras=self.refine_cameras,
            refine_frames=self.refine_frames,
            refine_gaussians=self.refine_gaussians,
            max_minutes=self.max_minutes,
            iterations_share=1.0 if self.iterations_share is None else self.iterations_share,
            iterations={step: count for step, count in given.items() if count is not None},
            batch=self.batch,
            gaussians=self.gaussians,
            blend_shapes=self.blend_shapes,
            max_megabytes=self.max_megabytes,
            teacher=not self.no_teacher,
            loose_parts=self.loose_parts,
            perceptual=self.perceptual,
            seed=self.seed,
            force=self.force,
            tensorboard=self.tensorboard,
            checkpoint_minutes=self.checkpoint_minutes,
            precision=self.precision,
            compile=self.compile,
            surface_normals={"preset": None, "on": True, "off": False}[self.surface_normals],
            readers=self.readers,
            cache_gib=self.cache_gib,
        )

    def _finish(self, records: dict[str, StageRecord]) -> dict[str, Any]:
        from pipelines.report.sections.build import rewrite_report

        report = self.run_folder / "report.html"
        # The page is rewritten if it lacks the new figures.
        ran = any(record.ran for record in records.values())
        if not self.no_report and (ran or not report.is_file()) and rewrite_report(self.run_folder) is None:
            log.warning("the run has no record of its build: `smplxpp build` writes the report")
        if not self.json:
            _print(records, report, force=self.force)
        stages = {
            name: {**record.manifest["numbers"], "ran": record.ran, "checks": record.manifest["checks"]}
            for name, record in records.items()
        }
        # Refinement has no entry among the stages when it is not wanted.
        last = self.steps()[-1]
        finished = all(record.finished for record in records.values()) and (last in stages or last == "refine")
        return {"run": str(self.run_folder), "finished": finished, "stages": stages}


def _print(records: dict[str, StageRecord], report: Path, *, force: bool) -> None:
    console = Console()
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    table.add_column("stage", no_wrap=True)
    for name in ("iterations", "seconds", "PSNR views", "SSIM", "PSNR poses", "MB"):
        table.add_column(name, justify="right")
    table.add_column("")
    for record in records.values():
        with values_of(record):
            table.add_row(*_row(record, force=force))
    console.print(table)
    if report.is_file():
        print_paths({"report": report}, console)


def _row(record: StageRecord, *, force: bool) -> tuple[str, ...]:
    """Return a stage's row of the table."""
    numbers = record.manifest["numbers"]
    stage = record.folder.name
    # A fit stores means by held-out and training views; other stages store them by kind of views.
    views = (
        numbers["mean"].get("held_out", numbers["mean"].get("train", {}))
        if stage == FIT_STAGE
        else (numbers.get("novel_view", {}))
    )
    poses = numbers.get("novel_pose", {})
    state = "" if numbers["finished"] else f"stopped: {how_to_continue(force=force)}"
    return (
        stage,
        f"{numbers['iterations_done']:,} of {numbers['iterations']:,}",
        f"{numbers['seconds_of_steps']:.0f}",
        *(
            f"{values[key]:.{digits}f}" if key in values else "-"
            for values, key, digits in ((views, "psnr", 2), (views, "ssim", 4), (poses, "psnr", 2))
        ),
        ", ".join(f"{size / 1e6:.1f}" for size in numbers.get("bytes", {}).values()) or "-",
        state if record.ran or state else "stands",
    )
