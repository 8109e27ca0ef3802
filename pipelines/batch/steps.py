"""What chains are made of: the commands that can be steps, in their order, and what a chain takes of a machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipelines.runs.layout import (
    BUILD_STAGES,
    EVALUATE_STAGE,
    MODEL_STAGES,
    RECONSTRUCT_STAGE,
    REFINE_STAGE,
    REGISTER_STAGE,
    RELIGHT_STAGE,
)
from smplxpp.core.errors import InputError, require_between


@dataclass(frozen=True)
class StepKind:
    """A command as a step of a chain.

    Attributes:
        words: of the command.
        module: that runs it, whose code is part of the batch's key.
        options: class of its options there.
        judged: whether exit status 1, checks that failed, ends the chain.
        on_gpu: whether it computes on a GPU where the job has one.
        stages: stages of the run whose manifests prove that it stands.
        files: files of the subject's folder that prove it; `{capture}` is the converted capture's folder.
    """

    words: tuple[str, ...]
    module: str
    options: str
    judged: bool = True
    on_gpu: bool = False
    stages: tuple[str, ...] = ()
    files: tuple[str, ...] = ()


STEPS: Mapping[str, StepKind] = {
    "convert": StepKind(
        ("capture", "convert"),
        "pipelines.commands.capture",
        "CaptureConvertCommand",
        judged=False,  # status 1 says that something was left out
        files=("capture/conversion.json", "capture/capture.json"),
    ),
    "check": StepKind(
        ("capture", "check"), "pipelines.commands.capture", "CaptureCheckCommand", files=("check/check.json",)
    ),
    "reconstruct": StepKind(
        ("reconstruct",),
        "pipelines.commands.reconstruct",
        "ReconstructCommand",
        stages=(RECONSTRUCT_STAGE,),
        files=("reconstruct/scans/seams.json",),
    ),
    "register": StepKind(
        ("register",),
        "pipelines.commands.register",
        "Register",
        stages=(REGISTER_STAGE,),
        files=("register/params.npz",),
    ),
    "metrics": StepKind(("metrics",), "pipelines.commands.metrics", "Metrics", files=("metrics.json",)),
    "build": StepKind(("build",), "pipelines.commands.build", "Build", stages=BUILD_STAGES),
    "refine": StepKind(("train",), "pipelines.commands.train", "Train", stages=(REFINE_STAGE,)),
    "train": StepKind(
        ("train",), "pipelines.commands.train", "Train", on_gpu=True, stages=(REFINE_STAGE, *MODEL_STAGES)
    ),
    "evaluate": StepKind(
        ("evaluate",), "pipelines.commands.evaluate", "Evaluate", on_gpu=True, stages=(EVALUATE_STAGE, RELIGHT_STAGE)
    ),
    "export": StepKind(("export",), "pipelines.commands.export", "Export", files=("{subject}.avatar", "{subject}.glb")),
    "web": StepKind(("web",), "pipelines.commands.web", "Web", files=("player.html",)),
}
"""The steps in the order in which they run."""
SPLIT = ("reconstruct", "register", "metrics", "refine")
"""Steps that can be split into chunks of frames: `frames` of a job."""
OF_REFINEMENT = ("params", "body", "protocol", "hold_out", "scale", "seed", "refine_poses", "refine_cameras")
"""Options of a training that decide its refinement."""


@dataclass(frozen=True)
class Needs:
    """What a job takes of a machine.

    Attributes:
        cores: threads of a command; 0: an equal share of the machine.
        gpus: GPUs of a training: a fraction where several trainings share one, several for one training by torchrun.
        minutes: limit of one stay on a cluster, after which a training continues in the next one; 0: none.
        gigabytes: memory to ask of a cluster; 0: what it gives by default.
    """

    cores: int = 0
    gpus: float = 1.0
    minutes: float = 0.0
    gigabytes: float = 0.0

    def __post_init__(self) -> None:
        require_between("resources: cores", self.cores, 0, 4096)
        require_between("resources: gpus", self.gpus, 0.0, 64.0)
        if self.gpus > 1 and self.gpus != int(self.gpus):
            raise InputError(
                "resources: gpus", expected="a fraction of one, or a whole number", received=f"{self.gpus:g}"
            )
        require_between("resources: minutes", self.minutes, 0.0, 1e6)
        require_between("resources: gigabytes", self.gigabytes, 0.0, 1e5)
