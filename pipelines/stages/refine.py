"""Stage 66: refine the poses of the training frames on the photographs of the training cameras, with pictures."""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path
from typing import Literal

import numpy as np

from avatar.data.sequence import AvatarSequence
from avatar.data.views import read_view
from avatar.metrics.view_quality import eight_bit
from avatar.models.student import Student, StudentConfig
from avatar.rendering.avatar_view import render_view
from avatar.rig.rig import at_rest
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.refine import Refinement
from avatar.training.refinement.refine_capture import refine_capture
from avatar.training.scene import TrainScene
from pipelines.figures.comparison import write_tiles
from pipelines.runs import gates
from pipelines.runs.code import TRAINING
from pipelines.runs.folders import own_run_folder
from pipelines.runs.layout import REFINE_STAGE, REFINED_PARAMS, REGISTERED_PARAMS
from pipelines.runs.stage import Stage, StageOutput, StageRecord, run_stage
from pipelines.stages.run_inputs import params_in_use, params_to_begin_with, record_of_given
from pipelines.stages.scene import TrainInputs, of_protocol, open_scene, open_views
from smplxpp.capture.declared import has_estimated_params
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.core.files import atomic_write_text, jsonable

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
    held_out: bool = True,
    force: bool = False,
    progress: ProgressCallback = ignore_progress,
) -> StageRecord:
    """Refine the poses of a run's capture, unless template, capture, code and choices are unchanged.

    The files are those of `refine_capture`. Readers of the refined parameters read the corrected cameras too.

    Args:
        run: folder of the run.
        inputs: sources of the views, with the initial parameters.
        config: choices of the refinement.
        held_out: whether held-out frames are refined too.
        force: refine even if the stage stands.
        progress: called with the share of the evaluations of frames that are done.

    Raises:
        InputError: see `open_scene`.
    """
    # Start from the parameters before any refinement, so that the result does not depend on how often it ran.
    scene = open_scene(run, inputs, refined=False)
    stage = Stage(
        name=REFINE_STAGE,
        config={"refinement": config, "reference": scene.frame, "scale": inputs.scale, "held_out": held_out},
        inputs=scene.digests,
        code=(__name__,),
        libraries=TRAINING,
        seed=config.seed,
        resumable=True,
    )
    with own_run_folder(run, (REFINE_STAGE, "report")):
        return run_stage(
            run,
            stage,
            lambda folder: _work(scene, inputs, config, folder, run / stage.work_name, progress, held_out=held_out),
            force=force,
        )


def _work(
    scene: TrainScene,
    inputs: TrainInputs,
    config: RefineConfig,
    folder: Path,
    state: Path,
    progress: ProgressCallback,
    *,
    held_out: bool,
) -> StageOutput:
    """Refine, write the files with pictures, and measure against the gates."""
    begin = time.perf_counter()
    # Frames whose loss rose keep their initial poses; a warning names them.
    refined = refine_capture(scene, config, folder, held_out=held_out, work=state, progress=progress)
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
        rendered = []
        # Render with the initial and the refined pose, at rest (without learned deformation), so that only the pose
        # differs.
        for params in (found.start, found.params):
            with at_rest(avatar):
                posed = avatar(sequence.rig.pose(params.frame(int(row))), view.position[None])
                rendered.append(eight_bit(render_view(posed, 0, view, sequence.background).image).numpy())
        file = f"pictures/{view.name}_{frame:06d}.png"
        write_tiles(folder / file, view.photograph(sequence.background.tolist()), rendered)
        out.append({"file": file, "title": f"frame {frame}, {view.name}"})
    return out
