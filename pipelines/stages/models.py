"""Stages that train a model: what decides each, and how they are made from each other's files."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol

from avatar.baselines.build import outer_template
from avatar.data.sequence import AvatarSequence, SequenceConfig
from avatar.losses.perceptual import PerceptualDistance
from avatar.models.model_file import load_avatar, save_avatar
from avatar.rig.rig import Rig
from avatar.training.engine.loop import Progress
from avatar.training.engine.photometric_task import PhotometricConfig
from avatar.training.engine.processes import Distributed
from avatar.training.engine.resources import Compiled, allow_tf32, explain_resource_errors, keep_freed_memory
from avatar.training.engine.session import Session
from pipelines.runs.artefacts import values_of
from pipelines.runs.code import TRAINING
from pipelines.runs.folders import own_run_folder
from pipelines.runs.stage import (
    Stage,
    StageOutput,
    StageRecord,
    decide,
    differences,
    read_manifest,
    run_stage,
    standing,
)
from pipelines.stages.scene import TrainScene, preview_writer, seen_of
from smplxpp.core.errors import InputError
from smplxpp.template.template import Template

CLOTHED, NAKED, OUTER = "clothed", "naked", "outer"
GROUNDS: Mapping[str, Callable[[Template], Template]] = {
    CLOTHED: lambda template: template,
    NAKED: Template.naked,
    OUTER: outer_template,
}
"""Templates that models are trained on, made from the person's."""
ONE_STEP = 1e-9
"""Least time in seconds of a training that begins, so that it takes at least one step."""
Bar = Callable[[str, int], AbstractContextManager[Callable[[Progress], None]]]


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """How training runs; nothing in it changes what comes out.

    Attributes:
        max_seconds: time after which training stops, with a checkpoint and the model reached so far.
        force: train again even what is up to date.
        tensorboard: log for TensorBoard into the folders of the stages.
        checkpoint_seconds: between two checkpoints, see `LoopConfig`.
        bar: called with a stage's name and iterations; shows its progress.
        precision: of networks on a GPU, see `TrainConfig`.
        compile: how networks are compiled on a GPU.
        readers: threads that decode photographs, see `SequenceConfig`.
        cache_gib: see `AvatarSequence`.
    """

    max_seconds: float = float("inf")
    force: bool = False
    tensorboard: bool = False
    checkpoint_seconds: float | None = None
    bar: Bar = field(default=lambda name, total: nullcontext(lambda progress: None))
    precision: str = "preset"
    compile: Compiled = "off"
    readers: int | None = None
    cache_gib: float | None = None


class StageConfig(Protocol):
    """Fields that the configuration of every stage has."""

    @property
    def seed(self) -> int:
        """The seed of what is drawn."""

    @property
    def iterations(self) -> int:
        """Return the number of steps of the training."""


@dataclass(frozen=True, kw_only=True)
class ModelStage(ABC):
    """A model that is trained once. Its settings and the files that it needs decide what comes out.

    Attributes:
        name: name of its folder in the run.
        config: configuration of the training.
        ground: key of `GROUNDS`, the template that it is trained on.
        elsewhere: other folders of the run that may hold the same model already.
    """

    file: ClassVar[str]
    """The model in the stage's folder."""
    resumable: ClassVar[bool] = True
    alone: ClassVar[bool] = False
    """Whether rank 0 trains it alone, while the other processes wait."""

    name: str
    config: StageConfig
    ground: str = CLOTHED
    elsewhere: tuple[str, ...] = ()

    @property
    @abstractmethod
    def needs(self) -> Mapping[str, ModelStage]:
        """The stages whose models it is made from, by the part that they play."""

    @property
    def seed(self) -> int:
        """The seed of what is drawn."""
        return self.config.seed

    @property
    def iterations(self) -> int:
        """Steps of the training, for its progress."""
        return self.config.iterations

    @abstractmethod
    def settings(self, trainer: Trainer) -> Mapping[str, Any]:
        """Every choice that decides it, but for those of the stages that it needs."""

    def inputs(self, trainer: Trainer) -> Mapping[str, str]:
        """Digests by name of what it reads beside the models that it needs."""
        return trainer.scene.digests

    @abstractmethod
    def work(self, trainer: Trainer, session: Session, folder: Path) -> StageOutput:
        """Train, from the session's checkpoint if there is one, and write the model into `folder`.

        Every process calls it; all but the first have no folder to write to, and their answer is not used.
        """

    def read(self, path: Path, rig: Rig) -> Any:
        """Read the model in a file of this stage."""
        return load_avatar(path, rig)

    def read_by(self, trainer: Trainer, path: Path) -> Any:
        """`read` for a model that is more than its file."""
        return self.read(path, trainer.sequence(self.ground).rig)

    def write_player(self, path: Path, model: Any) -> None:
        """Write what a player needs of the model, in half precision."""
        save_avatar(path, model, compact=True)


class Trainer:
    """Makes the model stages of a run on one scene.

    Args:
        run: folder of the run.
        scene: template and capture.
        options: limits and display.
        together: processes that train together.
        scale: scale of the images, part of every stage's key.
        perceptual: metric of the perceptual loss term; None leaves the term out.
    """

    def __init__(
        self,
        run: Path,
        scene: TrainScene,
        options: TrainOptions,
        together: Distributed,
        *,
        scale: float = 1.0,
        perceptual: PerceptualDistance | None = None,
    ) -> None:
        self.run, self.scene, self.options, self.together = run, scene, options, together
        self.scale, self.perceptual = scale, perceptual
        # Stages share one deadline, sequences and records: a preset trains several models on the same data.
        self._deadline = time.monotonic() + options.max_seconds
        self._sequences: dict[str, AvatarSequence] = {}
        self._finished: dict[str, StageRecord] = {}
        keep_freed_memory()
        allow_tf32(options.precision)

    @property
    def device(self) -> str:
        """ "cpu" or "cuda"."""
        return self.together.device.split(":")[0]

    def perceptual_name(self, config: PhotometricConfig) -> str | None:
        """Return the name of the metric of a training's perceptual term; None without the term."""
        return None if self.perceptual is None or not config.weights.perceptual else self.perceptual.name

    def seconds_left(self) -> float:
        """Return the seconds until the time limit, the same on every process; 0 after it."""
        return self.together.run_on_rank0(lambda: max(0.0, self._deadline - time.monotonic()))

    def sequence(self, ground: str) -> AvatarSequence:
        """Return the capture with one of the templates of `GROUNDS`; all of them share its images."""
        if ground not in self._sequences:
            template = GROUNDS[ground](self.scene.template)
            reading, kept = SequenceConfig(readers=self.options.readers), self.options.cache_gib
            made = AvatarSequence(self.scene.capture, template, reading, device=self.together.device, cache_gib=kept)
            self._sequences[ground] = made
        return self._sequences[ground]

    def model(self, stage: ModelStage) -> Any:
        """Load the finished model of a stage."""
        return stage.read_by(self, self.path(stage))

    def path(self, stage: ModelStage) -> Path:
        """Return the model file of a finished stage.

        Raises:
            InputError: it is missing or unfinished.
        """
        found = self.found(stage)
        if found is None or not found.finished:
            raise InputError(
                f"run {self.run}",
                expected=f"a finished {stage.name}",
                received=self._instead(stage, found),
                remedy="give the same command without --stage, which trains what is missing",
            )
        return found.folder / stage.file

    def _instead(self, stage: ModelStage, found: StageRecord | None) -> str:
        """Describe the state of an unfinished stage for an error message."""
        if found is not None:
            numbers = found.manifest["numbers"]
            return f"{numbers.get('iterations_done')} of {numbers.get('iterations')} iterations of it"
        manifest = read_manifest(self.run / stage.name)
        needs = (self.found(one) for one in stage.needs.values())
        if manifest is None or any(need is None or not need.finished for need in needs):
            return "none"
        return f"one that was made otherwise: {differences(manifest, self.identity(stage))}"

    def found(self, stage: ModelStage) -> StageRecord | None:
        """Return the record of an up-to-date stage, in its own folder or elsewhere in the run; None without one."""
        # Keys of finished stages are not computed again: their digests cover large files.
        if stage.name in self._finished:
            return self._finished[stage.name]
        # A stage whose sources are missing or unfinished has no key and therefore cannot be up to date.
        if any((need := self.found(one)) is None or not need.finished for one in stage.needs.values()):
            return None
        identity = self.identity(stage)
        # An unfinished training counts only in its own folder, where it can be resumed.
        for name in (stage.name, *stage.elsewhere):
            record = standing(self.run / name, identity)
            if record is not None and (record.finished or name == stage.name):
                if record.finished:
                    self._finished[stage.name] = record
                return record
        return None

    def take(self, stage: ModelStage, record: StageRecord) -> None:
        """Accept a record of the run as a finished stage, whatever its key."""
        self._finished[stage.name] = record

    def identity(self, stage: ModelStage) -> Stage:
        """Return the identity (name, configuration, digests, code) of a stage whose sources are finished."""
        # The key contains the digest of every source model, so that a source trained again invalidates this one.
        digests, sources = dict(stage.inputs(self)), {}
        for part, needed in stage.needs.items():
            path = self.path(needed)
            with values_of(self._finished[needed.name]):
                digests[part] = self._finished[needed.name].manifest["files"][needed.file]
            sources[part] = path.relative_to(self.run).as_posix()
        # Only a template other than the person's own enters the key.
        ground = {} if stage.ground == CLOTHED else {"ground": stage.ground}
        return Stage(
            name=stage.name,
            config={**stage.settings(self), **ground, "device": self.device, "scale": self.scale},
            inputs=digests,
            code=(type(stage).__module__,),
            libraries=TRAINING,
            seed=stage.seed,
            resumable=stage.resumable,
            sources=sources,
        )

    def make(self, stage: ModelStage, *, force: bool | None = None) -> StageRecord:
        """Train a stage unless it stands; what it needs has to stand.

        A training that was interrupted, or that reached its time limit, resumes from its checkpoint. Rank 0 writes,
        the other processes train with it.

        Args:
            stage: the stage to train.
            force: train again even if it is up to date; None takes the options' choice.

        Raises:
            InputError: something it needs is missing or unfinished, its state is of another training, memory or disk
                ran out, or training diverged; checkpoints and finished stages stay.
        """
        force = self.options.force if force is None else force
        # Forget the record, or `found` would return the old model for the rest of this command.
        if force:
            self._finished.pop(stage.name, None)
        # Only rank 0 trains; the other processes wait for its record.
        if stage.alone:
            return self.together.run_on_rank0(lambda: self._make(stage, force=force), kinds=(StageRecord,))
        return self._make(stage, force=force)

    def _make(self, stage: ModelStage, *, force: bool) -> StageRecord:
        together, shared = self.together, not stage.alone
        if shared:
            # A missing source raises here on every rank, before the folder is touched.
            together.run_on_rank0(lambda: [str(self.path(needed)) for needed in stage.needs.values()])
        # Every collective call below has its partner in `_first`, in the same order. An unequal number of calls would
        # block all processes.
        if not together.first:
            work, key, runs = together.run_on_rank0(_nothing)
            if runs:
                stage.work(self, self._session(stage, work, key), self.run / stage.name)
            record = together.run_on_rank0(_nothing, kinds=(StageRecord,))
        else:
            # Only rank 0 holds the lock and writes.
            with own_run_folder((self.run / stage.name).parent, (Path(stage.name).name, "report")):
                record = self._first(stage, shared=shared, force=force)
            record = together.run_on_rank0(lambda: record, kinds=(StageRecord,)) if shared else record
        if record.finished:
            self._finished[stage.name] = record
        return record

    def _first(self, stage: ModelStage, *, shared: bool, force: bool) -> StageRecord:
        """Decide on rank 0 whether to train, broadcast the decision, train and write."""
        identity: Stage

        def decided() -> tuple[str, str, bool]:
            nonlocal identity
            identity = self.identity(stage)
            return identity.work_name, identity.key, decide(self.run, identity, force=force) != "skip"

        # The other ranks learn from this call whether there is anything to train.
        name, key, _ = self.together.run_on_rank0(decided) if shared else decided()

        def work(folder: Path) -> StageOutput:
            with explain_resource_errors(self.run), self.options.bar(stage.name, stage.iterations) as report:
                output = stage.work(self, replace(self._session(stage, name, key), report=report), folder)
            # Recorded for later commands, which refuse to call a seen view novel.
            output.numbers["seen"] = self._seen(stage)
            output.numbers["protocol"] = self.scene.capture.protocol
            return output

        return run_stage(self.run, identity, work, force=force)

    def _session(self, stage: ModelStage, work: str, key: str) -> Session:
        folder = self.run / work
        # A stage trained by rank 0 alone must not call a collective.
        left = self._deadline - time.monotonic() if stage.alone else self.seconds_left()
        return Session(
            folder,
            key,
            self.perceptual,
            self.together,
            max(left, ONE_STEP),
            tensorboard=self.options.tensorboard,
            checkpoint_seconds=self.options.checkpoint_seconds,
            preview=preview_writer(self.scene.capture, folder),
            compile=self.options.compile,
        )

    def _seen(self, stage: ModelStage) -> dict[str, list[Any]]:
        """Return the cameras and frames that the model learned from, directly or through its source models."""
        splits, scene = self.scene.capture.splits, self.scene
        # Stages for one process read the reference frame; the others read all training frames.
        frames = {scene.frame} if stage.alone else set(splits.train_frames)
        cameras = set(splits.train_cameras)
        # What a source model has seen, this one has seen through it.
        for needed in stage.needs.values():
            seen = seen_of(self._finished[needed.name])
            if seen is not None:
                cameras |= seen.cameras
                frames |= seen.frames
        # The template's shape comes from that frame's scan.
        if scene.template_frame is not None:
            frames.add(scene.template_frame)
        return {"cameras": sorted(cameras), "frames": sorted(frames)}


def _nothing() -> Any:
    """Stand in for the work of rank 0 on processes that only receive its result."""
    raise AssertionError
