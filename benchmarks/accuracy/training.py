"""Measure the training of a run: minutes, steps a second, memory and quality of each stage, shares of a step.

    python -m benchmarks training --run RUN --capture DIR

reads what `smplxpp train` and `smplxpp evaluate` left in RUN, and takes a few steps of every stage again under a
profiler. Times are of the process alone on the machine or they mean little: `--no-profile` where it is shared.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from torch.profiler import ProfilerActivity, profile

from avatar.data.sequence import AvatarSequence
from avatar.evaluation.report import EvalReport
from avatar.gaussians.tensor_file import load_bound
from avatar.models.model_file import load_avatar
from avatar.models.tracked_surface import TrackedAvatar
from avatar.training.fit_teacher import PretrainTeacherTask, TeacherTask
from avatar.training.presets import TrainingPreset, training_preset
from avatar.training.student.bake import BakeTask
from avatar.training.student.compensate import CompensateTask
from avatar.training.student.pretrain import PretrainFieldTask
from avatar.training.tracking.config import TrackConfig
from avatar.training.tracking.track import TrackTask
from benchmarks.support.results import store_results
from pipelines.runs import layout
from pipelines.runs.stage import read_manifest
from pipelines.stages.run_inputs import run_protocol
from smplxpp.capture import open_capture
from smplxpp.capture.protocols import TRACKED
from smplxpp.core.errors import InputError
from smplxpp.template.template import Template

STAGES = tuple(stage for stage in layout.MODEL_STAGES if stage != layout.CLOTH_STAGE)
WARM_UP, TIMED = 3, 14
KINDS = {
    "rasteriser": ("_Rasterize",),
    "image loss": ("_Ssim", "l1_loss", "smooth_l1"),
    "networks": ("conv", "mkldnn", "mm", "addmm", "bmm", "linear", "relu", "_SymmetricFilter"),
    "maps and control points": ("_Bags", "embedding_bag", "InterpolateFunction", "BarycentricFunction"),
    "skinning and Gaussians": ("_Skinning", "FramesFunction", "WorldFunction", "ColorsFunction"),
    "optimiser": ("_fused", "_foreach", "Optimizer"),
}
"""Kinds of torch's operations by parts of their names; the first kind that fits counts."""


@dataclass(frozen=True)
class TrainingBenchmark:
    """Store a training's figures and where its time goes."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Run that was trained and evaluated."""
    capture: Path
    """Folder of its capture."""
    preset: Literal["paper-small", "cpu", "demo"] = "cpu"
    """Preset of the training."""
    profile: bool = True
    """Take a few steps of every stage again, to see where their time goes."""

    def run(self) -> None:
        """Read, profile, print, store."""
        figures = {
            "preset": self.preset,
            "threads": torch.get_num_threads(),
            "stages": {name: stage_figures(self.run_folder / name) for name in STAGES},
            **evaluation_conditions(self.run_folder / layout.EVALUATION),
            "evaluation": evaluation_figures(self.run_folder / layout.EVALUATION),
        }
        preset = training_preset(self.preset)
        if self.profile:
            figures["share_of_a_step"] = profiles(self.run_folder, self.capture, preset)
        figures["minutes"] = round(sum(stage["seconds"] for stage in figures["stages"].values()) / 60.0, 2)
        print(json.dumps(figures, indent=1))
        protocol = figures["inputs"]["name"]
        # The name of the results states a shortened training and tracked inputs, so that none is taken for a full one.
        share = figures["stages"][layout.COMPENSATE_STAGE]["iterations"] / preset.compensate.iterations
        of_all = "" if share == 1 else f" --iterations-share {share:g}"
        name = f"training_{open_capture(self.capture).name}_{self.preset}"
        name += ("" if share == 1 else f"_times_{share:g}") + (f"_{TRACKED}" if protocol == TRACKED else "")
        commands = (
            f"smplxpp train RUN --capture DIR --preset {self.preset}{of_all}",
            "smplxpp evaluate RUN --capture DIR",
            f"python -m benchmarks training --run RUN --capture DIR --preset {self.preset}",
        )
        path = store_results(name, "; ".join(commands) + ("" if self.profile else " --no-profile"), figures)
        print(f"stored {path.name}")


def stage_figures(folder: Path) -> dict[str, Any]:
    """Collect the figures of one training.

    Raises:
        InputError: it has not been finished.
    """
    manifest = read_manifest(folder) if folder.is_dir() else None
    if manifest is None or not manifest["numbers"].get("finished"):
        raise InputError(
            f"training {folder.name}",
            expected="a finished one",
            received=str(folder),
            remedy="train with `smplxpp train RUN --capture DIR`",
        )
    numbers = manifest["numbers"]
    kept = (
        "iterations",
        "iterations_per_second",
        "seconds_of_steps",
        "seconds_of_tracking",
        "seconds_of_pretraining",
        "gaussians",
        "bytes",
        "start",
        "novel_view",
        "novel_pose",
    )
    # Some figures are of one stage only, as the seconds of tracking of the teacher.
    found = {"seconds": manifest["seconds"], **{name: numbers[name] for name in kept if name in numbers}}
    if "parameters" in numbers:
        found["parameters"] = numbers["parameters"]["total"]
    if "peak_memory" in numbers:
        found["peak_memory_gib"] = numbers["peak_memory"]["host"] / 2**30
    return _rounded(found)


def evaluation_figures(path: Path) -> dict[str, Any]:
    """Collect images, surfaces by label, speed and bytes of every model.

    Raises:
        InputError: the run has not been evaluated.
    """
    stored = _stored_evaluation(path)
    figures = {
        name: {
            "views": {part: _with_counts(model, part) for part in model["mean"]},
            "surfaces": _surfaces(model["surfaces"]),
            "speed": model["speed"],
            "bytes": model["bytes"],
        }
        for name, model in stored["models"].items()
    }
    figures["skinning alone"] = {"surfaces": _surfaces(stored["skinning_alone"])}
    return _rounded(figures)


def evaluation_conditions(path: Path) -> dict[str, Any]:
    """Collect what the figures of an evaluation rest on, and the name of the perceptual distance.

    Raises:
        InputError: the run has not been evaluated.
    """
    stored = _stored_evaluation(path)
    return {"inputs": stored["inputs"], "perceptual": stored["metric"]}


def _with_counts(model: Mapping[str, Any], part: str) -> dict[str, Any]:
    """Return the means of a set with their standard deviations over frames, and what they were taken over."""
    spread = {f"{name} SD": value for name, value in model["spread"][part].items()}
    return {**model["mean"][part], **spread, **model["counts"][part]}


def _stored_evaluation(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(
            "evaluation of the run",
            expected=str(path),
            received="no such file",
            remedy="make it with `smplxpp evaluate RUN --capture DIR`",
        )
    return EvalReport.load(path).as_dict()


def _surfaces(surfaces: Mapping[str, Any]) -> dict[str, Any]:
    out = {}
    for part, found in surfaces.items():
        mean = found["mean"]
        out[part] = {"frames": len(found["frames"]), "p2s": mean["p2s"], "p2s SD": found["spread"]["p2s"]}
        out[part] |= {"chamfer": mean["chamfer"]}
        out[part] |= {f"p2s {label}": figures["p2s"] for label, figures in mean["labels"].items()}
    return out


def _rounded(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _rounded(each) for key, each in value.items()}
    return float(f"{value:.5g}") if isinstance(value, float) else value


def profiles(run: Path, capture: Path, preset: TrainingPreset) -> dict[str, dict[str, float]]:
    """Milliseconds of a step of every training, and the shares of each kind of work in it."""
    protocol = run_protocol(run)
    sequence = AvatarSequence(open_capture(capture, protocol=protocol), Template.load(run / layout.TEMPLATE))
    rig = sequence.rig
    teacher = load_avatar(run / layout.TEACHER, rig)
    baked = load_avatar(run / layout.BAKED, rig)
    student = load_avatar(run / layout.STUDENT, rig)
    track, pretrain, bake = preset.teacher.track, preset.teacher.pretrain, preset.bake

    def tracking(config: TrackConfig) -> Callable[[int], Any]:
        gaussians = load_bound(run / layout.GAUSSIANS)
        avatar = TrackedAvatar(rig, gaussians, config.control_points, still_body=config.still_body)
        task = TrackTask(sequence, avatar, config)
        # A frame's steps are on images of several sizes: as many of each as in a whole frame.
        return lambda k: task.step(config.steps * (k // TIMED) + k % TIMED * config.steps // TIMED)

    # Made one after the other: the bake's task freezes the teacher.
    tasks = {
        "tracking": track and (lambda: tracking(track)),
        "teacher's pretraining": pretrain
        and (lambda: PretrainTeacherTask(sequence, teacher, pretrain, 0, teacher.track).step),
        "teacher": lambda: TeacherTask(sequence, teacher.train(), preset.teacher).step,
        "bake's pretraining": bake.pretrain
        and (
            lambda: (
                PretrainFieldTask(
                    sequence,
                    baked,
                    teacher,
                    bake.pretrain,
                    0,
                    code_lr_factor=bake.code_lr_factor,
                    null_share=0.0 if bake.regression else bake.null_share,
                ).step
            )
        ),
        "bake": lambda: BakeTask(sequence, baked.train(), bake, teacher=teacher).step,
        "compensation": lambda: CompensateTask(sequence, student.train(), preset.compensate).step,
    }
    return {name: _profile(task()) for name, task in tasks.items() if task}


def _profile(step: Callable[[int], Any]) -> dict[str, float]:
    for k in range(WARM_UP):
        step(k)
    with profile(activities=[ProfilerActivity.CPU]) as profiler:
        for k in range(TIMED):
            step(k)
    events = profiler.key_averages()
    # Backward passes run in a thread of their own while the first waits: self times of both add up to the wall's.
    times = dict.fromkeys((*KINDS, "other tensors"), 0.0)
    for event in events:
        kind = next((kind for kind, names in KINDS.items() if any(n in event.key for n in names)), "other tensors")
        times[kind] += event.self_cpu_time_total
    wall = max(event.time_range.end for event in profiler.events()) - min(e.time_range.start for e in profiler.events())
    times["Python, poses, reading"] = max(0.0, wall - sum(times.values()))
    shares = {name: round(value / wall, 3) for name, value in times.items()}
    return {"milliseconds": round(wall / TIMED / 1e3, 2), **shares}


if __name__ == "__main__":
    tyro.cli(TrainingBenchmark, prog="python -m benchmarks training").run()
