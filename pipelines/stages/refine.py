"""Stage 66: refine the poses of the training frames on the photographs of the training cameras, with pictures."""

from __future__ import annotations

import json
import logging
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np

from avatar.data.sequence import AvatarSequence
from avatar.data.views import read_view
from avatar.metrics.view_quality import eight_bit
from avatar.models.student import Student, StudentConfig
from avatar.rendering.avatar_view import render_view
from avatar.rig.rig import at_rest
from avatar.training.refinement.board import RefinementStoppedError
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.refine import Refinement
from avatar.training.refinement.refine_capture import RefinedCapture, refine_capture
from avatar.training.scene import TrainScene
from pipelines.runs import gates
from pipelines.runs.code import TRAINING
from pipelines.runs.folders import own_run_folder
from pipelines.runs.layout import REFINE_STAGE, REFINED_PARAMS, REGISTERED_PARAMS
from pipelines.runs.stage import Stage, StageOutput, StageRecord, begin_state, decide, run_stage
from pipelines.stages.run_inputs import params_in_use, params_to_begin_with, record_of_given
from pipelines.stages.scene import TrainInputs, of_protocol, open_scene, open_views
from smplxpp.capture.declared import has_estimated_params
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.core.files import atomic_write_text, jsonable
from smplxpp.figures.drawings import write_tiles

log = logging.getLogger(__name__)


def wants_refinement(run: Path, inputs: TrainInputs, choice: Literal["auto", "on", "off"]) -> bool:
    """Return whether a training refines poses first: "auto" where parameters are estimated, or were refined before.

    Raises:
        InputError: "off" in a run with refined parameters, which later stages would read nevertheless.
    """
    stands = params_in_use(run, inputs.params) == run / REFINED_PARAMS
    # Every later stage reads refined parameters where they exist, so that "off" could not be honoured.
    if choice == "off" and stands:
        raise InputError(
            f"run {run}",
            expected="no refined parameters, with --refine-poses off",
            received=REFINED_PARAMS,
            remedy=f"delete {run / REFINE_STAGE}, or train in another run folder",
        )
    if choice != "auto":
        return choice == "on"
    # Registered parameters are always estimates; those of a capture are what its protocol declares.
    begins = params_to_begin_with(run, inputs.params)
    if stands or begins == run / REGISTERED_PARAMS:
        return True
    # These parameters alone decide, whatever the template was built with.
    return has_estimated_params(open_views(of_protocol(run, inputs)))


def refine(
    run: Path,
    inputs: TrainInputs,
    config: RefineConfig,
    *,
    scene: TrainScene | None = None,
    force: bool = False,
    progress: ProgressCallback = ignore_progress,
    stop: Callable[[], bool] = lambda: False,
    device: str = "cpu",
) -> StageRecord:
    """Refine the poses of a run's capture, unless template, capture, code and choices are unchanged.

    The files are those of `refine_capture`. Readers of the refined parameters read the corrected cameras too.

    Args:
        run: folder of the run.
        inputs: sources of the views, with the initial parameters.
        config: choices of the refinement.
        scene: of these inputs, opened without refined poses; None: it is opened.
        force: refine even if the stage stands.
        progress: called with the share of the evaluations of frames that are done.
        stop: asked after every pass and every chunk; then the record is unfinished, and the same call continues.
        device: where pictures are drawn and compared. It is no part of the key, because poses differ by rounding alone.

    Raises:
        InputError: see `open_scene`.
    """
    # Start from the parameters before any refinement, so that the result does not depend on how often it ran.
    scene = open_scene(run, inputs, refined=False) if scene is None else scene
    stage = _stage(scene, inputs, config)

    def work(folder: Path) -> StageOutput:
        begin, state = time.perf_counter(), run / stage.work_name
        try:
            refined = refine_capture(scene, config, folder, work=state, progress=progress, stop=stop, device=device)
        except RefinementStoppedError:
            seconds = time.perf_counter() - begin
            return StageOutput(
                [], {"finished": False, "iterations": 1, "iterations_done": 0, "seconds_of_steps": seconds}
            )
        return _output(refined, scene, inputs, folder, begin)

    with own_run_folder(run, (REFINE_STAGE, "report")):
        return run_stage(run, stage, work, force=force)


def help_refine(
    run: Path,
    inputs: TrainInputs,
    config: RefineConfig,
    *,
    scene: TrainScene | None = None,
    stop: Callable[[], bool] = lambda: False,
    device: str = "cpu",
) -> bool:
    """Compute chunks of a refinement that other processes work at, too; `refine` then finds them, and ends the stage.

    Any number of processes may call it, on all machines that see the run. None of them holds its lock.

    Args:
        run: folder of the run.
        inputs: as of `refine`.
        config: as of `refine`.
        scene: as of `refine`.
        stop: asked after every pass and every chunk.
        device: as of `refine`.

    Returns:
        Whether nothing is left to compute.

    Raises:
        InputError: the state of a refinement with other choices.
    """
    scene = open_scene(run, inputs, refined=False) if scene is None else scene
    stage = _stage(scene, inputs, config)
    if decide(run, stage) == "skip":
        return True
    state = begin_state(run, stage)
    with tempfile.TemporaryDirectory() as folder, suppress(RefinementStoppedError):
        refine_capture(scene, config, Path(folder), work=state, stop=stop, device=device)
        return True
    return False


def _stage(scene: TrainScene, inputs: TrainInputs, config: RefineConfig) -> Stage:
    return Stage(
        name=REFINE_STAGE,
        config={"refinement": config, "reference": scene.frame, "scale": inputs.scale, "held_out": True},
        inputs=scene.digests,
        code=(__name__,),
        libraries=TRAINING,
        seed=config.seed,
        resumable=True,
    )


def _output(refined: RefinedCapture, scene: TrainScene, inputs: TrainInputs, folder: Path, begin: float) -> StageOutput:
    """Write the figures and pictures, and measure against the gates."""
    # Frames whose loss rose keep their initial poses; a warning names them.
    found = refined.training
    if found.kept:
        log.warning("frames %s keep their poses: refined ones fit worse", " ".join(map(str, found.kept)))
    numbers = refined.figures()
    atomic_write_text(folder / "refinement.json", json.dumps(jsonable(numbers), indent=1))
    # Evaluations of a frame stand for iterations in the report.
    looks = len(found.frames) * len(found.history)
    splits = scene.capture.splits
    # Check the start (silhouettes), the share of frames that improved, and the total loss.
    checks = [
        gates.SILHOUETTE.check(
            "template's silhouette on the masks",
            scene.overlap,
            explanation="before refinement, mean over some training views; low: poses too far off to refine",
        ),
        gates.REFINED.check(
            "frames whose photographs fit better than before",
            1.0 - len(found.kept) / len(found.frames),
            explanation="the others keep their poses",
        ),
        gates.REFINED_LOSS.check(
            "loss of the photographs against the start",
            float(found.after.mean() / max(found.before.mean(), 1e-12)),
            explanation="over the pixels of what sits firmly on the body, all training frames and cameras",
        ),
    ]
    # `given` identifies the initial parameters: refined ones are used only with the same start. `seen` lists what later
    # models learn from through these poses.
    numbers |= {
        "given": record_of_given(inputs.params),
        "pictures": write_pictures(folder, refined.sequence, found),
        "iterations": looks,
        "iterations_done": looks,
        "finished": True,
        "seconds_of_steps": time.perf_counter() - begin,
        "seen": {"cameras": sorted(splits.train_cameras), "frames": sorted(splits.train_frames)},
    }
    return StageOutput(checks, numbers)


def write_pictures(folder: Path, sequence: AvatarSequence, found: Refinement) -> list[dict[str, str]]:
    """Write `pictures/CAM_FFFFFF.png` of the worst frames, seen by the camera that sees most of the person.

    Returns:
        File and title of each, the worst first.
    """
    shown_frames = 4  # number of frames with pictures: those with the largest loss after refinement
    avatar = Student(StudentConfig(field=None), sequence.rig, found.gaussians.to(device=sequence.device), ())
    out = []
    # The stable sort keeps the order of frames with equal losses.
    for row in np.argsort(-found.after, kind="stable")[:shown_frames]:
        frame = found.frames[row]
        # Choose the camera with the largest foreground.
        names = [name for name in sequence.train_cameras if sequence.capture.file(name, frame) is not None]
        views = [read_view(sequence.capture, name, frame) for name in names]
        view = max(views, key=lambda one: np.count_nonzero(one.alpha.numpy()))
        there, rendered = view.to(sequence.device), []
        # Render with the initial and the refined pose, at rest (without learned deformation), so that only the pose
        # differs.
        for params in (found.start, found.params):
            with at_rest(avatar):
                posed = avatar(sequence.rig.pose(params.frame(int(row))), there.position[None])
                rendered.append(eight_bit(render_view(posed, 0, there, sequence.background).image).numpy())
        file = f"pictures/{view.name}_{frame:06d}.png"
        write_tiles(folder / file, view.photograph(sequence.background.tolist()), rendered)
        out.append({"file": file, "title": f"frame {frame}, {view.name}"})
    return out
